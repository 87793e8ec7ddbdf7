"""Files are watched however they are replaced, and a look that fails ends nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from router.app import watching
from router.app.watching import Watcher

PATIENCE = 20


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are looked at five times as often."""
    monkeypatch.setattr(watching, "PERIOD", 0.1)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    path.write_text("version: 1\n")
    return path


@contextmanager
def watched(files: Callable[[], Iterable[Path]]) -> Iterator[threading.Event]:
    changed = threading.Event()
    with closing(Watcher(files, changed.set)):
        yield changed


def written(table: Path) -> None:
    table.write_text("version: 1 # more\n")


def replaced(table: Path) -> None:
    beside = table.with_suffix(".new")
    beside.write_bytes(table.read_bytes())
    beside.replace(table)


def moved_away_and_written_anew(table: Path) -> None:
    table.rename(table.with_suffix(".bak"))
    table.write_text("version: 1\n")


@pytest.mark.parametrize("change", [written, replaced, moved_away_and_written_anew])
def test_editors_are_noticed(table: Path, change: Callable[[Path], None]) -> None:
    with watched(lambda: [table]) as changed:
        change(table)
        assert changed.wait(PATIENCE)


def test_a_folder_that_is_swapped_behind_symbolic_links_is_noticed(tmp_path: Path) -> None:
    """As Kubernetes does it."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "table.yaml").write_text("version: 1\n")
    data, table = tmp_path / "..data", tmp_path / "table.yaml"
    data.symlink_to("one")
    table.symlink_to("..data/table.yaml")
    with watched(lambda: [table]) as changed:
        (tmp_path / "new").symlink_to("two")
        (tmp_path / "new").replace(data)
        assert changed.wait(PATIENCE)


def test_a_look_that_fails_is_made_again(table: Path) -> None:
    failures = iter([None, OSError("the folder went while it was listed")])

    def files() -> list[Path]:
        if (failure := next(failures, None)) is not None:
            raise failure
        return [table]

    with watched(files) as changed:
        written(table)
        assert changed.wait(PATIENCE)


def test_it_can_be_closed_by_whom_it_waits_for(table: Path) -> None:
    """A reload that ends the watching, while a changed file asks for a reload."""
    one_at_a_time, asked = threading.Lock(), threading.Event()

    def reload() -> None:
        asked.set()
        with one_at_a_time:
            pass

    with one_at_a_time:
        watcher = Watcher(lambda: [table], reload)
        written(table)
        assert asked.wait(PATIENCE)
        watcher.close()
