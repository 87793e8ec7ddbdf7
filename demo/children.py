"""Child processes that never outlive the demo, whatever ends it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import IO, Any

PATIENCE = 5.0
"""Seconds to wait for a child's exit before it is killed."""

LAST_WORDS = 4000
"""Bytes of stderr worth showing."""


class Child:
    """A running Python module that prints JSON lines; `latest` is the newest.

    It has a session of its own, so that Ctrl-C reaches only the demo, which then ends its children in order.
    """

    def __init__(self, name: str, env: Mapping[str, str], *module: str) -> None:
        self.name = name
        self.latest: dict[str, Any] = {}
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the object exists
        self._process = subprocess.Popen(
            [sys.executable, "-m", "demo.tied", *module],
            env=dict(env),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            start_new_session=True,
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise AssertionError("Popen opened no pipes")
        self._stdin = self._process.stdin
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True)
        self._reader.start()

    def _read(self, lines: IO[bytes]) -> None:
        with lines:
            for line in lines:
                if line.startswith(b"{"):
                    self.latest = json.loads(line)

    def tell(self, line: str) -> None:
        """Write a line to its stdin. Does nothing if it has ended."""
        with suppress(BrokenPipeError):
            self._stdin.write(line.encode() + b"\n")
            self._stdin.flush()

    @property
    def exit_code(self) -> int | None:
        """The exit code; None while it runs."""
        return self._process.poll()

    def ask_to_end(self) -> None:
        if self.exit_code is None:
            self._process.send_signal(signal.SIGTERM)

    def end(self) -> None:
        """Send SIGTERM, wait, kill after PATIENCE, and read the output to its end."""
        self.ask_to_end()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._reader.join(PATIENCE)
        with suppress(BrokenPipeError):
            self._stdin.close()

    def last_words(self) -> str:
        """The end of its stderr, read without moving the file position that the child shares."""
        size = os.fstat(self._stderr.fileno()).st_size
        start = max(0, size - LAST_WORDS)
        return os.pread(self._stderr.fileno(), size - start, start).decode(errors="replace").strip()
