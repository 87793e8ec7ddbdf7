"""HTTP: what Prometheus scrapes. Stage 0: H3 puts the rest here."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable
from pathlib import Path

from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server

from router.edges.port_holder import port_holder
from router.edges.running import Running
from router.errors import SourceSpan, StartError
from router.table.model import Address


class HttpServer:
    """Serves the collector's metrics and those of the process at `address` until closed."""

    def __init__(
        self, address: Address, span: SourceSpan, running: Running, save: Callable[[str], Path] | None
    ) -> None:
        registry = CollectorRegistry()
        registry.register(running)
        ProcessCollector(registry=registry)
        try:
            self._server, self._thread = start_http_server(address.port, address.host, registry)
        except OSError as error:
            in_use = error.errno == errno.EADDRINUSE
            why = f"{port_holder('tcp', address.port)} has the port" if in_use else error.strerror
            raise StartError(
                f"{span}: metrics cannot be served at {address}: {why}; choose another metrics.address"
            ) from error
        self.address = Address(address.host, self._server.server_port)

    def close(self) -> None:
        # The server looks every half second whether it is to stop, and whenever its socket stirs.
        self._server.socket.shutdown(socket.SHUT_RDWR)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
