"""Opens sockets at a local address, now or as soon as this machine has that address."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress

from router.errors import StartError
from router.gateway.transport.base import report_fault
from router.log import logger
from router.net.addresses import open_socket, socket_address
from router.net.kernel import why_not_bound
from router.table.addresses import Address

RETRY_SECONDS = 1.0
"""The interval of attempts to open an address that this machine does not have."""

_ABSENT = (errno.EADDRNOTAVAIL, errno.ENODEV)
"""Errors of binding to an address that this machine does not have, or to one of a missing network interface."""

MOST_UNACCEPTED = 1024
"""The listen backlog: this many clients can connect at once."""

RECEIVE_BUFFER = 64 * 1024
"""Bytes of a client's receive buffer: clients send little, and there may be a thousand."""


class Binding:
    """Calls `attempt` until it succeeds. `protocol` is udp or tcp."""

    def __init__(self, protocol: str, address: Address, attempt: Callable[[], Awaitable[None]]) -> None:
        self._protocol = protocol
        self._address = address
        self._attempt = attempt
        self._retrying: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Attempt now; if no network interface has the address yet, in the background. Otherwise raises StartError."""
        try:
            await self._attempt()
        except OSError as error:
            if error.errno not in _ABSENT:
                raise self._refusal(error) from error
            logger.warning("no network interface has this address yet; waiting for it", address=str(self._address))
            self._retrying = asyncio.get_running_loop().create_task(self._retry())

    async def close(self) -> None:
        if self._retrying is not None:
            self._retrying.cancel()
            with suppress(asyncio.CancelledError):
                await self._retrying

    async def _retry(self) -> None:
        reported = None
        while True:
            await asyncio.sleep(RETRY_SECONDS)
            try:
                await self._attempt()
            except OSError as error:
                if error.errno not in (None, *_ABSENT, reported):
                    reported = error.errno
                    logger.error("cannot bind to the address; retrying", why=str(self._refusal(error)))
            except Exception as error:  # noqa: BLE001 - a fault of the router is reported; retry
                report_fault(f"kept {self._address} from being opened", error)
            else:
                logger.info("the address exists now; listening", address=str(self._address))
                return

    def _refusal(self, error: OSError) -> StartError:
        kind, why, remedy = why_not_bound(self._protocol, self._address.port, error)
        return kind(f"{self._address} cannot be used: {why}", remedy)


def listen_at(address: Address) -> socket.socket:
    """Return a non-blocking TCP socket that listens on `address`. Raises OSError."""
    opened = open_socket(address.host, socket.SOCK_STREAM)
    try:
        # Lets a restarted router bind while old connections end; a port with another listener is still refused.
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        opened.setblocking(False)
        opened.bind(socket_address(*address))
        opened.listen(MOST_UNACCEPTED)
    except OSError:
        opened.close()
        raise
    return opened
