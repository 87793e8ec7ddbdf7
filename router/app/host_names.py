"""Resolves the host names of endpoints in the background. A resolver may hang, so each name has a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping

from router.clock import monotonic_ns
from router.log import logger
from router.net.addresses import addresses_of
from router.threads import Thread

_RETRY_S = 2.0
"""Seconds from one attempt to the next while there is no address, or nothing is heard from it."""

_REFRESH_NS = 60_000_000_000


class HostNames:
    """The addresses of host names. Once resolved, a name keeps its address until the resolver has another one.

    `changed` is called in a thread of this class when `hosts` has changed; if it returns False, it is called again.
    `is_silent`: nothing is heard from the endpoints with a name. `why_unusable` returns why they cannot have an
    address, or "". `close` does not wait.
    """

    def __init__(
        self,
        changed: Callable[[], bool],
        is_silent: Callable[[str], bool],
        why_unusable: Callable[[str, str], str],
    ) -> None:
        self.hosts: Mapping[str, str] = {}
        self._changed = changed
        self._is_silent = is_silent
        self._why_unusable = why_unusable
        self._wanted: Collection[str] = ()
        self._running: set[str] = set()
        self._lock = threading.Lock()
        self._stopped = threading.Event()

    def follow(self, wanted: Collection[str]) -> None:
        """Resolve these names, and no others."""
        with self._lock:
            self._wanted = wanted
            new = {*wanted} - self._running
            self._running.update(new)
        for name in new:
            Thread(self._run, "name", (name,)).start()

    def close(self) -> None:
        self._stopped.set()

    def _run(self, name: str) -> None:
        resolved_at, reported, is_due = 0, "", True
        while not self._stopped.is_set():
            with self._lock:
                if name not in self._wanted:
                    self._running.discard(name)
                    return
            if is_due:
                why = self._resolve(name)
                if why and why != reported and name not in self.hosts:
                    logger.warning(
                        "host name not resolved: nothing is sent to its endpoints, or accepted from them",
                        host=name,
                        why=why,
                        remedy=f"check the name with `getent ahosts {name}`, or write the address",
                    )
                reported, resolved_at = why, monotonic_ns()
            self._stopped.wait(_RETRY_S)
            is_late = monotonic_ns() - resolved_at >= _REFRESH_NS
            is_due = bool(reported) or is_late or self._is_silent(name)

    def _resolve(self, name: str) -> str:
        """Look a name up, and adopt its address if that is another one. Return why it has none, or ""."""
        try:
            found = addresses_of(name)
        except OSError as error:
            return error.strerror or str(error)
        before = self.hosts.get(name)
        if before in found:
            return ""
        reasons = [self._why_unusable(name, host) for host in found]
        host = next((host for host, why in zip(found, reasons, strict=True) if not why), None)
        if host is None:
            return ", ".join(dict.fromkeys(reasons)) or "it has no address"
        with self._lock:
            self.hosts = {**self.hosts, name: host}
        if not self._changed():
            with self._lock:
                self.hosts = {key: value for key, value in self.hosts.items() if key != name}
                if before is not None:
                    self.hosts = {**self.hosts, name: before}
            return "the router could not adopt its address"
        event = "host name resolved" if before is None else "host name has another address"
        logger.info(event, host=name, address=host, **({"before": before} if before is not None else {}))
        return ""
