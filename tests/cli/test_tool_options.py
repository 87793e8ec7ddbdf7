"""What verbs share: which table, numbers with units, and progress for whoever looks."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable, Iterable

import pytest
from rich.progress import ProgressColumn, TextColumn

from router.cli.tool_options import hertz, progress, seconds, speed


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (seconds, "10s", 10.0),
        (seconds, "250ms", 0.25),
        (hertz, "20Hz", 20.0),
        (hertz, "0.5 Hz", 0.5),
        (speed, "2x", 2.0),
        (speed, "0.5x", 0.5),
        (speed, "max", math.inf),
    ],
)
def test_numbers_have_units(parse: Callable[[str], float], text: str, value: float) -> None:
    assert parse(text) == value


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def columns() -> Iterable[ProgressColumn]:
    return (TextColumn("{task.description} {task.completed} of {task.total}"),)


def test_progress_is_shown_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with progress(columns, 12) as tell:
        tell(description="sending", completed=7)
    assert "sending 7 of 12" in terminal.getvalue()


def test_without_a_terminal_nothing_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(columns, 12) as tell:
        tell(description="sending", completed=7)
    assert capsys.readouterr() == ("", "")
