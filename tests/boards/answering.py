"""A board in C with nanopb that answers requests and calls a service, badly: see answering.c."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from tests.acceptance.ros_peer import PATIENCE
from tests.boards.board import compiled

_PROTOS = Path(__file__).parent.parent / "bad_tables/protos/calls"


class AnsweringBoard:
    """`with AnsweringBoard(folder, address, router, seed=1) as board:`; compiled into `folder`."""

    def __init__(self, folder: Path, address: tuple[str, int], router: tuple[str, int], seed: int) -> None:
        program = compiled(folder, _PROTOS, "envelope.proto", "PBEnvelope", "answering.c")
        words = [str(word) for word in (*address, *router, seed)]
        self._process = subprocess.Popen([program, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> AnsweringBoard:
        self._line()
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._process.communicate(timeout=PATIENCE)
            assert self._process.returncode == 0
        finally:
            self._process.kill()

    def _line(self) -> dict[str, int]:
        assert self._process.stdout is not None
        counts: dict[str, int] = json.loads(self._process.stdout.readline())
        return counts

    def call(self, times: int) -> dict[str, int]:
        """Call the service so many more times, and return the counts so far."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{times}\n")
        self._process.stdin.flush()
        return self._line()

    def counts(self) -> dict[str, int]:
        return self.call(0)
