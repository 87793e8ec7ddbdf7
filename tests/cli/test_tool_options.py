"""What verbs share: which table, numbers with units, and progress for whoever looks."""

from __future__ import annotations

import argparse
import io
import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from rich.progress import ProgressColumn, TextColumn

from router.cli import main
from router.cli.tool_options import add_table, factor, hertz, named_table, progress, seconds, speed, table_path
from router.errors import UsageError


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_table(parser, is_subject=True)
    return parser.parse_args(words)


@pytest.mark.parametrize(
    ("words", "environment", "table"),
    [
        ((), "", "routes/rover.yaml"),
        ((), "of_environment.yaml", "of_environment.yaml"),
        (("-t", "option.yaml"), "of_environment.yaml", "option.yaml"),
        (("subject.yaml",), "of_environment.yaml", "subject.yaml"),
        (("subject.yaml", "--table", "./subject.yaml"), "", "subject.yaml"),
    ],
)
def test_the_table_is_typed_or_of_the_environment_or_the_default(
    words: tuple[str, ...], environment: str, table: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("routes").mkdir()
    Path("routes/rover.yaml").touch()
    monkeypatch.setenv("ROUTER_TABLE", environment)
    assert table_path(parsed(*words)) == Path(table)


def test_two_tables_and_none_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROUTER_TABLE", raising=False)
    with pytest.raises(UsageError, match=r"the table is a\.yaml or, by --table, b\.yaml; name one"):
        named_table(parsed("a.yaml", "-t", "b.yaml"))
    with pytest.raises(UsageError, match=r"no routes/rover\.yaml here; name a table by -t .* `router init DIR`"):
        table_path(parsed())


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


@pytest.mark.parametrize(
    ("parse", "texts"),
    [(seconds, ("", "10 parsecs")), (hertz, ("20/s",)), (speed, ("x", "2xx", "1e9x", "fast")), (factor, ("max",))],
)
def test_other_texts_are_refused(parse: Callable[[str], float], texts: tuple[str, ...]) -> None:
    for text in texts:
        with pytest.raises(argparse.ArgumentTypeError):
            parse(text)


@pytest.mark.parametrize(("parse", "meant"), [(seconds, "10s"), (hertz, "10Hz"), (speed, "10x")])
def test_a_number_without_its_unit_gets_a_suggestion(parse: Callable[[str], float], meant: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=rf"^'10' has no unit\nhelp: did you mean '{meant}'\?$"):
        parse("10")


@pytest.mark.parametrize(
    "words", ["tap --for 0s", "tap --for -1s", "send imu_info --to rover --rate -5Hz", "replay it.mcap --speed -1x"]
)
def test_what_is_not_above_zero_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(words.split())
    assert f"'{words.rpartition(' ')[2]}' is not above zero\n" in capsys.readouterr().err


@pytest.mark.parametrize("words", ["tap --count x", "sim --seed x", "new Dose --board arm --number x"])
def test_what_is_counted_is_a_whole_number(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(words.split())
    assert "'x' is not a whole number\n" in capsys.readouterr().err


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
