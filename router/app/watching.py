"""Watches the files of the table for changes, and the network interfaces of listeners."""

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
from router.threads import Thread
from router.types.proto_files import walk

PERIOD = 0.5
"""Seconds between two checks. A reload waits until two checks in a row see the same files: editors write in pieces."""

UNCHANGED_TIMEOUT = 5.0
"""Seconds for which a reload waits for files that are being written."""

INTERFACE_PERIOD = 1.0
"""Seconds between two checks of network interfaces."""

_Snapshot = dict[Path, tuple[int, int, int]]


class Watcher:
    """Calls `changed` in a thread of its own when `files` have changed.

    `close` does not wait, because `changed` may wait for its caller; `changed` may be called once more. `files` may
    raise OSError, for example if a folder is removed while it is listed; then the check is repeated.
    """

    def __init__(self, files: Callable[[], Iterable[Path]], changed: Callable[[], object]) -> None:
        self._files = files
        self._changed = changed
        self._handled = self._snapshot()
        self._stopped = threading.Event()
        self._thread = Thread(self._run, "watch")
        self._thread.start()

    def close(self) -> None:
        self._stopped.set()

    def _run(self) -> None:
        before = self._handled
        while not self._stopped.wait(PERIOD):
            now = self._snapshot()
            if now is not None and now == before and now != self._handled:
                logger.info("files of the table have changed; reloading")
                self._changed()
                self._handled = now
                after = self._snapshot() or now  # possibly of other files than before the reload
                if now.items() & after.items() == {each for each in after.items() if each[0] in now}:
                    self._handled = after
                before = after
            else:
                before = now

    def _snapshot(self) -> _Snapshot | None:
        """Return the state of the files, or None on an error."""
        try:
            return _snapshot(self._files())
        except OSError:
            return None


class InterfaceWatcher:
    """Checks once a second whether `listeners` have their addresses and network interfaces.

    After a tunnel or an adapter was removed and has come back, a socket stays bound to the old interface and receives
    nothing; a waiting socket was never bound. `reopen` is called each time in the watcher's thread, and makes them
    receive. A socket whose address is gone receives again when the address comes back. `close` does not wait.
    """

    def __init__(self, listeners: Callable[[], Iterable[Listener]], reopen: Callable[[], object]) -> None:
        self._listeners = listeners
        self._reopen = reopen
        self._stopped = threading.Event()
        Thread(self._run, "interfaces").start()

    def close(self) -> None:
        self._stopped.set()

    def _run(self) -> None:
        reported: list[Listener] = []
        while not self._stopped.wait(INTERFACE_PERIOD):
            lost = [each for each in self._listeners() if each.lacks_network()]
            for each in lost:
                if each not in reported and not each.is_waiting:
                    what = "the network interface" if each.has_lost_interface() else "the address"
                    logger.error(f"{what} is gone: the listener receives nothing", listener=each.name)
            self._reopen()
            if back := [each.name for each in reported if each in self._listeners() and each not in lost]:
                logger.info("these listeners now receive: their networks are up", listeners=back)
            reported = lost


def watched_files(table: RouteTable) -> list[Path]:
    """Return the table, the tables it extends, Zenoh configurations, lock files, and all files beside protos."""
    configs = [each.zenoh.config for each in table.gateways.values() if each.zenoh and each.zenoh.config]
    paths = [config.path for config in configs if config.path is not None]
    protos = (path for envelope in table.envelopes.values() for path in walk(envelope.protos.value))
    locks = [envelope.lock_file for envelope in table.envelopes.values()]
    paths += [lock.value for lock in locks if lock is not None]
    return [*table.files, *paths, *protos]


def wait_until_unchanged(files: Iterable[Path], until: int) -> bool:
    """Wait until no file was written within the last PERIOD. Return whether the wait was necessary.

    `until` is in ns of the monotonic clock; raises StartError if files are still written then.
    """
    files = list(files)
    before = _snapshot(files)
    ages = [(wall_ns() - written) / 1e9 for written, _, _ in before.values()]
    young = [age for age in ages if 0 <= age < PERIOD]  # a time in the future is ignored
    if not young:
        return False
    sleep(PERIOD - min(young))
    while before != (now := _snapshot(files)):
        if monotonic_ns() > until:
            changing = ", ".join(sorted({str(path) for path, _ in before.items() ^ now.items()}))
            raise StartError(f"these files are still being written: {changing}")
        before = now
        sleep(PERIOD)
    return True


def _snapshot(files: Iterable[Path]) -> _Snapshot:
    """Return time, size and inode of the files that exist."""
    found = {}
    for path in files:
        try:
            status = path.stat()
        except OSError:
            continue
        found[path] = status.st_mtime_ns, status.st_size, status.st_ino
    return found
