"""A board in C with nanopb and the dispatcher of the real firmware, so it obeys what a real board would.

Every bound of the `.options` beside the protos is compiled into it.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from queue import Empty, Queue
from typing import NamedTuple

import pytest

from router.carrier.build import compile_c
from tests.acceptance.ros_peer import PATIENCE

PARTS = Path(__file__).parent / "protos"
"""Protos with bounded strings, bytes and lists, unlike the rover's."""

OPTIONS = Path(__file__).parent / "options"
"""Protos with nanopb's options in them."""

REQUIRED = Path(__file__).parent / "required"
"""Protos with required fields."""

_HEADERS = (Path("/usr/include"), Path("/usr/include/nanopb"))
"""nanopb's folder in Debian's packages, by version."""


def skip_without_nanopb() -> None:
    if not any((headers / "pb_decode.h").exists() for headers in _HEADERS):
        pytest.skip("needs nanopb's library for C (libnanopb-dev)")


def compiled(folder: Path, protos: Path, header: str, envelope: str, source: str = "board.c") -> Path:
    """Compile a board, a file beside this one, for the message `envelope` of the `.proto` file `header` in `folder`."""
    skip_without_nanopb()
    names = [path.relative_to(protos).as_posix() for path in sorted(protos.rglob("*.proto"))]
    generator = [sys.executable, "-m", "nanopb.generator.nanopb_generator", "-q", "-I", ".", "-D", str(folder)]
    subprocess.run([*generator, *names], cwd=protos, check=True, capture_output=True, timeout=60)
    made = folder / "board"
    options = [f'-DPROTO="{Path(header).with_suffix(".pb.h")}"', f"-DENVELOPE={envelope}", f"-I{folder}"]
    options += [f"-idirafter{headers}" for headers in _HEADERS]
    sources = [str(Path(__file__).with_name(source)), *map(str, sorted(folder.rglob("*.pb.c")))]
    compile_c([*options, *sources, "-lprotobuf-nanopb", "-o", str(made)])
    return made


class Verdict(NamedTuple):
    """The result for one datagram: the envelope re-encoded by nanopb, or the reason of the refusal."""

    case: int = 0
    envelope: bytes = b""
    refused: str = ""
    datagram: bytes = b""


class Board:
    """A running board at `address`, which sends to the router's address."""

    def __init__(self, program: Path, address: tuple[str, int], router: tuple[str, int]) -> None:
        self.address = address
        words = [str(word) for pair in (address, router) for word in pair]
        self._process = subprocess.Popen(
            [program, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self._verdicts: Queue[Verdict] = Queue()
        self.obeyed = 0
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._commands, self._lines = self._process.stdin, self._process.stdout
        assert self._lines.readline() == "ready\n"
        self._reader = threading.Thread(target=self._read)

    def __enter__(self) -> Board:
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._commands.close()
        try:
            assert self._process.wait(PATIENCE) == 0
        finally:
            self._process.kill()
            self._reader.join(PATIENCE)
            self._lines.close()

    def _read(self) -> None:
        for line in self._lines:
            outcome, first, rest = line.rstrip("\n").split(" ", 2)
            if outcome == "obeyed":
                self.obeyed += 1
                self._verdicts.put(Verdict(int(first), bytes.fromhex(rest)))
            else:
                self._verdicts.put(Verdict(refused=rest, datagram=bytes.fromhex(first)))

    def receive(self) -> Verdict:
        """Wait for the next datagram and return its verdict."""
        return self._verdicts.get(timeout=PATIENCE)

    def waiting(self) -> list[Verdict]:
        """The verdicts on all other datagrams that have arrived."""
        found = []
        try:
            while True:
                found.append(self._verdicts.get_nowait())
        except Empty:
            return found

    def send(self, form: str, *envelopes: bytes) -> None:
        """Send envelopes, re-encoded by nanopb as `exact`, `trimmed` or `padded`, or unchanged as `raw`."""
        for envelope in envelopes:
            self._commands.write(f"{form} {envelope.hex()}\n")
