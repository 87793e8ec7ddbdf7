"""The threads of a process, as /proc shows them. A thread that ends while they are read is left out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def of_threads(process: int | str, read: Callable[[Path], T]) -> list[T]:
    """What `read` returns for the folder of each thread. `process` is a pid or `self`."""
    found = []
    for task in Path(f"/proc/{process}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):
            found.append(read(task))
    return found


def name_of(task: Path) -> str:
    return (task / "comm").read_text().strip()


def thread_names() -> list[str]:
    """The names of this process's threads, also of those that Python does not know."""
    return of_threads("self", name_of)
