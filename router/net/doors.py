"""How TCP servers listen, and whom they admit: clients of the networks in `from`, and no pages of other hosts."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections import Counter
from collections.abc import Sequence

from router.errors import SourceSpan
from router.log import FloodLog, logger
from router.net.addresses import family, socket_address
from router.net.kernel import why_not_bound
from router.table.addresses import Address, IPNetwork

_LOCAL = re.compile(r"([0-9.]+|\[[0-9a-f:.]+\]|[a-z0-9-]+|[a-z0-9.-]+\.(local|lan|internal|home\.arpa))(:[0-9]+)?")
"""IP addresses, and names that nobody can register on the internet."""


def listen(address: Address, span: SourceSpan, what: str, key: str) -> socket.socket:
    """Return a listening socket. Raises StartError at `span`, which says that `what` cannot be served.

    `key` is that of the address in a table.
    """
    try:
        return socket.create_server(socket_address(*address), family=family(address.host), backlog=256)
    except OSError as error:
        kind, why, _ = why_not_bound("tcp", address.port, error)
        raise kind(f"{span}: cannot serve {what} at {address}: {why}", f"choose another {key}") from error


def is_own_computer(peer: str, own: str) -> bool:
    """Return whether a client at IP address `peer`, connected to our address `own`, is on the router's computer.

    Behind a proxy on this computer, all clients are. So this is no permission for anything that strangers may not do.
    """
    return ipaddress.ip_address(peer).is_loopback or peer == own


def is_foreign(hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Return whether a page of another host may have sent a request with these `Host` and `Origin` headers.

    Any page that is open in a browser could otherwise read and publish. Names that anybody can register are not trusted
    (DNS rebinding).
    """
    named = [host.lower() for host in hosts]
    if len(named) != 1 or not _LOCAL.fullmatch(named[0]):
        return True
    return any(origin.lower().partition("://")[2] != named[0] for origin in origins)


class Door:
    """Admits clients of `networks`, or all if there are none, and always the router's own computer.

    Counts refused connections in `refused`, under `server`, and logs each address once. Use it in one thread.
    """

    def __init__(self, server: str, networks: Sequence[IPNetwork], refused: Counter[str]) -> None:
        self._server = server
        self._networks = networks
        self._refused = refused
        self._refused[server] += 0
        self._log = FloodLog()

    def admits(self, peer: str, own: str) -> bool:
        """Return whether a client at IP address `peer`, connected to our address `own`, may connect."""
        if not self._networks or is_own_computer(peer, own):
            return True
        if any(ipaddress.ip_address(peer) in network for network in self._networks):
            return True
        self._refused[self._server] += 1
        event = "connection refused: the client's address is not in a network of 'from'"
        self._log.note(peer, logger.warning, event, server=self._server, client=peer)
        self._log.flush()
        return False

    def close(self) -> None:
        """Log what is not logged yet."""
        self._log.flush(final=True)
