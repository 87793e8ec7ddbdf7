"""The UDP sockets of the running program; sockets that the next program also uses stay open.

Its image opens serial lines.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field

from router.app.change import Change
from router.carrier.sender import NativeSender
from router.compiler.network import destination, sent_from
from router.errors import ConfigurationError
from router.hosts import any_of, bracketed, is_any, is_loopback, zone
from router.log import logger
from router.net.addresses import know
from router.net.sockets import ListeningSocket, placed
from router.net.udp import Listener, absence, open_sending, usual_source, why_no_way
from router.startup_image.head_start import HeadStart
from router.table.addresses import BadAddressError
from router.table.model import endpoints


@dataclass(slots=True)
class SocketChange:
    """All sockets of the next program: listeners by name, senders by endpoint.

    `moves` are new sockets for senders that stay, each with the listener whose port it uses. `opened` closes the
    sockets opened for the change, and `unused` those that it does not use. `left` are the listeners among these.
    """

    listeners: dict[str, Listener]
    senders: dict[str, NativeSender]
    moves: list[tuple[NativeSender, ListeningSocket | None, socket.socket]]
    left: list[Listener | ListeningSocket]
    opened: ExitStack
    unused: ExitStack = field(default_factory=ExitStack)


def _log_absence(listener: endpoints.Listener) -> None:
    host = listener.address.value._replace(port=0)  # the port may be taken, by an inherited socket
    why, remedy = absence(host, listener.interface) or ("its network is gone", "")
    what = "this listener receives nothing until its network is up; the others work"
    logger.warning(what, listener=listener.name, address=listener.bound_to, why=why, remedy=remedy)


def _check_reachable(endpoint: endpoints.Endpoint, is_new: bool) -> None:
    """Log why nothing can be sent to an endpoint now. Raises ConfigurationError for a broadcast address."""
    address = endpoint.address.value
    try:
        found = why_no_way(endpoint)
    except BadAddressError as error:
        if is_new:
            raise ConfigurationError(f"{endpoint.address.span}: {error.what}", error.hint) from error
        found = error.what, error.hint
    if found:
        why, remedy = found
        what = "nothing can be sent to this endpoint now; the router retries with every datagram"
        logger.warning(what, endpoint=endpoint.name, address=str(address), why=why, remedy=remedy)


def _check_source(endpoint: endpoints.Endpoint, sender: NativeSender) -> None:
    """Warn if datagrams leave with a source address other than that of the route to the endpoint."""
    own, usual = sender.leaves_from, usual_source(endpoint.address.value)
    if is_any(own) or own == usual or usual is None or is_loopback(usual):
        return
    logger.warning(
        "datagrams to this endpoint have another network's source address; firewalls may drop them",
        endpoint=endpoint.name,
        address=own,
        route=usual,
        remedy=f"use `send_from: ephemeral`, or a listener at {bracketed(any_of(own))} or at the address of the route",
    )


class KernelDrops:
    """Datagrams dropped by the kernel, by listener and by receiving gateway, including closed sockets."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[Callable[[], int], int]] = {}
        self._before: dict[str, int] = {}

    def follow(self, name: str, dropped: Callable[[], int], *, since: int = 0) -> None:
        """Count the drops of a socket for `name`: the result of `dropped`, minus `since`."""
        self.unfollow(name)
        self._now[name] = dropped, since

    def unfollow(self, name: str) -> None:
        """Stop counting for `name`, before its socket is closed or gets another name."""
        if name in self._now:
            dropped, since = self._now.pop(name)
            self._before[name] = self._before.get(name, 0) + dropped() - since

    def totals(self) -> Iterator[tuple[str, int]]:
        for name in [*self._now, *(self._before.keys() - self._now.keys())]:
            dropped, since = self._now.get(name, (int, 0))
            if (total := self._before.get(name, 0) + dropped() - since) or name in self._now:
                yield name, total


class Sockets:
    """Open listeners by name, and senders by endpoint. At first, these are the sockets of a head start if there is one.

    `library` is that of the carrier, which sends.
    """

    def __init__(self, drops: KernelDrops, library: ctypes.CDLL, head_start: HeadStart | None = None) -> None:
        self._library = library
        self.listeners: dict[str, Listener] = {}
        self._bound: dict[str, Listener] = {}  # by the address and interface in the table
        self._of_head_start: list[ListeningSocket] = [*head_start.listening.values()] if head_start else []
        self._senders: dict[str, tuple[object, NativeSender]] = {**head_start.senders} if head_start else {}
        self._link_local: list[str] = []
        self._drops = drops

    # adoption of another program

    def prepare(self, change: Change) -> None:
        """Open the sockets that are not open yet. Raises StartError or OSError."""
        program = change.program
        with ExitStack() as opening:
            listeners = {plan.name: self._listener(plan, opening) for plan in program.table.sockets}
            senders: dict[str, NativeSender] = {}
            moves = []
            every = [each.opened for each in (*self._bound.values(), *listeners.values())]
            for to in program.udp_senders:
                name = sent_from(program.table, to)
                source = placed(listeners.get(name) if name is not None else None, listeners.values())
                beside = source.opened if source is not None else None
                wanted, (known, sender) = destination(program.table, to), self._senders.get(to.name, (None, None))
                is_new = sender is None or known != wanted
                if to.address.value.is_known:
                    _check_reachable(to, is_new)
                if sender is None or is_new:
                    opened = open_sending(to, source, every)
                    address, _, cast = wanted
                    sender = NativeSender(self._library, address, opened, beside, cast)
                    opening.callback(sender.close)
                elif not sender.is_placed(beside, every):
                    opened = open_sending(to, source, every)
                    opening.callback(opened.close)
                    moves.append((sender, beside, opened))
                if to.address.value.is_known:
                    _check_source(to, sender)
                senders[to.name] = sender
            used = [each.opened for each in listeners.values()]
            left: list[Listener | ListeningSocket] = [each for each in self._bound.values() if each.opened not in used]
            left += [each for each in self._of_head_start if each not in used]
            change.sockets = SocketChange(listeners, senders, moves, left, opening.pop_all())

    def _listener(self, plan: endpoints.Listener, opening: ExitStack) -> Listener:
        """Return the open listener of a plan, or open it."""
        listener = self._bound.get(plan.bound_to)
        if listener is None or listener.is_replaceable():
            wanted = tuple(plan.address.value), plan.interface
            opened = next((each for each in self._of_head_start if each.wanted == wanted), None)
            listener = Listener(plan, opened=opened, has_senders=plan.address.value.port in self._sending_ports())
            if opened is None:
                opening.callback(listener.close)
        if listener.lacks_network():
            _log_absence(plan)
        return listener

    def _sending_ports(self) -> set[int]:
        """Return the ports that a listener and a sender share."""
        senders = [sender for _, sender in self._senders.values()]
        return {sender.source.address[1] for sender in senders if sender.source is not None and sender.is_bound}

    def undo(self, change: Change) -> None:
        """Close the sockets that `prepare` has opened."""
        if change.sockets is not None:
            change.sockets.opened.close()

    def adopt(self, change: Change) -> None:
        """Send and receive through the sockets of the change."""
        sockets, plans = change.sockets, change.program.table.listeners
        assert sockets is not None  # noqa: S101 - prepared
        sockets.opened.pop_all()
        for listener in sockets.left:
            sockets.unused.callback(listener.close)
        for endpoint, (_, sender) in self._senders.items():
            if sockets.senders.get(endpoint) is not sender:
                sockets.unused.callback(sender.close)
        for sender, source, opened in sockets.moves:
            sockets.unused.callback(sender.move(source, opened).close)
        self._follow_drops(sockets.listeners)
        for name, each in sockets.listeners.items():
            each.follow(plans[name])
        self.listeners, self._of_head_start = sockets.listeners, []
        self._bound = {plans[name].bound_to: each for name, each in sockets.listeners.items()}
        table = change.program.table
        senders = change.program.udp_senders
        self._senders = {to.name: (destination(table, to), sockets.senders[to.name]) for to in senders}
        addresses = [each.address.value for each in table.endpoints.values()]
        addresses += [each.address.value for each in table.listeners.values()]
        self._link_local = [host for host, _ in addresses if zone(host)]

    def finish(self, change: Change) -> None:
        """Close the sockets that only the earlier program used."""
        if change.sockets is not None:
            change.sockets.unused.close()

    def follow_interfaces(self) -> None:
        """Join and send to groups on the interfaces that have appeared, and find link-local hosts there.

        Not thread-safe.
        """
        for host in self._link_local:
            know(self._library, host)
        for listener in self.listeners.values():
            listener.join_groups()
        for _, sender in self._senders.values():
            sender.follow_interface()

    @property
    def may_lose_interfaces(self) -> bool:
        """Whether listeners or senders depend on addresses or interfaces that may disappear and return."""
        if self._link_local or any(sender.has_interface for _, sender in self._senders.values()):
            return True
        return any(
            each.interface or each.has_groups or each.is_waiting or not is_any(each.address.host)
            for each in self.listeners.values()
        )

    def close_listeners(self) -> None:
        for listener in self.listeners.values():
            listener.close()
        for opened in self._of_head_start:
            opened.close()

    def close_senders(self) -> None:
        for _, sender in self._senders.values():
            sender.close()

    def _follow_drops(self, listeners: Mapping[str, Listener]) -> None:
        moved = {name for name, each in self.listeners.items() if listeners.get(name) is not each}
        for name in moved:
            self._drops.unfollow(name)
        known = self._bound.values()
        for name, listener in listeners.items():
            if self.listeners.get(name) is not listener:
                since = listener.kernel_drops() if listener in known else 0
                self._drops.follow(name, listener.kernel_drops, since=since)
