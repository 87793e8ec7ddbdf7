"""Looks whether files have changed, and tells when they have come to rest. Knows nothing of what is in them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from router.compiler.program import Program
from router.edges.log import logger

PERIOD = 0.5
"""Seconds between two looks. A change is told when the second look finds it the same: editors write in pieces."""

_Look = dict[Path, tuple[int, int, int]]


class Watcher:
    """Calls `changed` in a thread of its own when `files` are not what they were.

    Closing it waits for nothing, for who closes it may be who `changed` waits for: it may be called once more.
    `files` may raise OSError, as folders do that go while they are listed: then it looks again.
    """

    def __init__(self, files: Callable[[], Iterable[Path]], changed: Callable[[], object]) -> None:
        self._files = files
        self._changed = changed
        self._seen = self._look()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stopped.set()

    def _run(self) -> None:
        before = self._seen
        while not self._stopped.wait(PERIOD):
            now = self._look()
            if now is not None and now == before and now != self._seen:
                logger.info("files of the table have changed: it is read again")
                self._changed()
                self._seen = now
                after = self._look() or now  # perhaps of other files: those are new, and have not changed
                if now.items() & after.items() == {each for each in after.items() if each[0] in now}:
                    self._seen = after
                before = after
            else:
                before = now

    def _look(self) -> _Look | None:
        """None where it cannot be seen now."""
        try:
            return _look(self._files())
        except OSError:
            return None


def watched_files(program: Program) -> list[Path]:
    """The table, what it extends, files for Zenoh, and everything beside its protos, new files there among them."""
    table = program.table
    configs = [each.zenoh.config for each in table.gateways.values() if each.zenoh and each.zenoh.config]
    paths = [config.path for config in configs if config.path is not None]
    return [*table.files, *paths, *table.envelope.protos.value.rglob("*")]


def _look(files: Iterable[Path]) -> _Look:
    """What can be seen of them without reading; what is not there is not in it."""
    found = {}
    for path in files:
        try:
            seen = path.stat()
        except OSError:
            continue
        found[path] = seen.st_mtime_ns, seen.st_size, seen.st_ino
    return found
