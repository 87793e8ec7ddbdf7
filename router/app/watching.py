"""Looks whether files have changed, and when they have come to rest. Knows nothing of what is in them.

And whether network interfaces of listeners have gone, and are back.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from time import sleep

from router.clock import monotonic_ns, wall_ns
from router.errors import StartError
from router.log import logger
from router.net.udp import Listener
from router.table.model import RouteTable
from router.types.proto_folder import walk

PERIOD = 0.5
"""Seconds between two looks. A change is told when the second look finds it the same: editors write in pieces."""

PATIENCE = 5.0
"""Seconds for which a reload that was asked for waits for files that do not come to rest."""

INTERFACE_PERIOD = 1.0
"""Seconds between two looks at network interfaces."""

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


class InterfaceWatcher:
    """Looks once a second whether `listeners` still have their network interfaces.

    A socket stays bound to the interface that there was: when a tunnel is set up again, or an adapter plugged in again,
    it hears nothing. Then `reopen` is called, in the watcher's thread, until it hears again. Closing waits for nothing.
    """

    def __init__(self, listeners: Callable[[], Iterable[Listener]], reopen: Callable[[], object]) -> None:
        self._listeners = listeners
        self._reopen = reopen
        self._stopped = threading.Event()
        threading.Thread(target=self._run, name="interfaces", daemon=True).start()

    def close(self) -> None:
        self._stopped.set()

    def _run(self) -> None:
        told: list[Listener] = []
        while not self._stopped.wait(INTERFACE_PERIOD):
            lost = [each for each in self._listeners() if each.has_lost_interface()]
            for each in lost:
                if each not in told:
                    logger.error("a network interface has gone: nothing comes in by it", listener=each.name)
            if lost:
                self._reopen()
            told = lost


def watched_files(table: RouteTable) -> list[Path]:
    """The table, what it extends, files for Zenoh, the lock, and everything beside its protos, new files among them."""
    configs = [each.zenoh.config for each in table.gateways.values() if each.zenoh and each.zenoh.config]
    paths = [config.path for config in configs if config.path is not None]
    protos: Iterable[Path] = ()
    if table.envelope is not None:
        protos = walk(table.envelope.protos.value)
        if table.envelope.lock is not None:
            paths.append(table.envelope.lock.value)
    return [*table.files, *paths, *protos]


def wait_for_rest(files: Iterable[Path], until: int) -> bool:
    """Waits for files that were written less than PERIOD ago, and returns whether there are any.

    `until` is in ns of the monotonic clock. Raises StartError if they are still written then.
    """
    files = list(files)
    seen = _look(files)
    ages = [(wall_ns() - written) / 1e9 for written, _, _ in seen.values()]
    young = [age for age in ages if 0 <= age < PERIOD]  # a time stamp of tomorrow says nothing
    if not young:
        return False
    sleep(PERIOD - min(young))
    while seen != (now := _look(files)):
        if monotonic_ns() > until:
            changing = ", ".join(sorted({str(path) for path, _ in seen.items() ^ now.items()}))
            raise StartError(f"these files are still being written: {changing}")
        seen = now
        sleep(PERIOD)
    return True


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
