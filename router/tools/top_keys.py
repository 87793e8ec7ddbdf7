"""Single keys from a terminal, while something else is shown on it."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from types import TracebackType


class Keys:
    """Until the context ends, keys come without Enter and are not shown. Without a terminal there are none."""

    def __init__(self) -> None:
        self._terminal = sys.stdin.fileno() if sys.stdin.isatty() else None
        self._before = termios.tcgetattr(self._terminal) if self._terminal is not None else None

    def __enter__(self) -> Keys:
        if self._terminal is not None:
            tty.setcbreak(self._terminal)
        return self

    def wait(self, seconds: float) -> str:
        """The next key, or nothing when none came in that time."""
        if self._terminal is None:
            time.sleep(seconds)
            return ""
        ready, _, _ = select.select([self._terminal], [], [], seconds)
        return os.read(self._terminal, 1).decode(errors="replace") if ready else ""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal is not None and self._before is not None:
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._before)
