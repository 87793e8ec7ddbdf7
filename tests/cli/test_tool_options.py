"""What verbs share: progress is for whoever looks, and for nobody else."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable

import pytest
from rich.progress import ProgressColumn, TextColumn

from router.cli.tool_options import progress


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
