"""The UDP sockets of the running program; sockets that the next program also uses stay open."""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field

from router.carrier.sender import NativeSender
from router.compiler.network import LOOPBACK, WILDCARD, sent_from
from router.compiler.program import Program
from router.errors import ConfigurationError
from router.log import logger
from router.net.sockets import ListeningSocket, placed
from router.net.udp import Listener, absence, open_sending, usual_source, why_unreachable
from router.table import model
from router.table.addresses import Address, BadAddressError


@dataclass(slots=True)
class SocketChange:
    """All sockets of the next program: listeners by name, senders by endpoint.

    `moves` are new sockets for senders that stay, each with the listener whose port it uses. `opened` closes the
    sockets opened for the change. Once the change is applied, `unused` closes the sockets that it does not use.
    """

    program: Program
    listeners: dict[str, Listener]
    senders: dict[str, NativeSender]
    moves: list[tuple[NativeSender, ListeningSocket | None, socket.socket]]
    opened: ExitStack
    unused: ExitStack = field(default_factory=ExitStack)


def _log_absence(listener: model.Listener) -> None:
    host = listener.address.value._replace(port=0)  # the port may be taken, by an inherited socket
    why, remedy = absence(host, listener.interface) or ("its network is gone", "")
    what = "this listener receives nothing until its network is up; the others work"
    logger.warning(what, listener=listener.name, address=listener.bound_to, why=why, remedy=remedy)


def _check_reachable(endpoint: model.Endpoint, is_new: bool) -> None:
    """Log why nothing can be sent to an endpoint now. Raises ConfigurationError for a broadcast address."""
    address = endpoint.address.value
    try:
        found = why_unreachable(address)
    except BadAddressError as error:
        if is_new:
            raise ConfigurationError(f"{endpoint.address.span}: {error.what}", error.hint) from error
        found = error.what, error.hint
    if found:
        why, remedy = found
        what = "nothing can be sent to this endpoint now; the router retries with every datagram"
        logger.warning(what, endpoint=endpoint.name, address=str(address), why=why, remedy=remedy)


def _check_source(endpoint: model.Endpoint, sender: NativeSender) -> None:
    """Warn if datagrams leave with a source address other than that of the route to the endpoint."""
    own, usual = sender.leaves_from, usual_source(endpoint.address.value)
    if own in (WILDCARD, usual) or usual is None or usual.startswith(LOOPBACK):
        return
    logger.warning(
        "datagrams to this endpoint have another network's source address; firewalls may drop them",
        endpoint=endpoint.name,
        address=own,
        route=usual,
        remedy="use `send_from: ephemeral`, or a listener at 0.0.0.0 or at the address of the route",
    )


_Destination = tuple[Address, model.EndpointKind]


def _destination(endpoint: model.Endpoint) -> _Destination:
    """Return the settings of an endpoint that its sender depends on."""
    return endpoint.address.value, endpoint.kind


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
    """Open listeners by name, and senders by endpoint; none before the first change is applied.

    `library` is that of the carrier, which sends.
    """

    def __init__(self, drops: KernelDrops, library: ctypes.CDLL) -> None:
        self._library = library
        self.listeners: dict[str, Listener] = {}
        self._bound: dict[str, Listener] = {}  # by the address and interface in the table
        self._senders: dict[str, tuple[_Destination, NativeSender]] = {}
        self._drops = drops

    def take_over(
        self, program: Program, listening: Mapping[str, ListeningSocket], senders: Mapping[str, NativeSender]
    ) -> None:
        """Adopt the sockets that a head start has opened for a program."""
        plans = {plan.name: plan for plan in program.listeners}
        self.listeners = {name: Listener(plans[name], opened=opened) for name, opened in listening.items()}
        self._bound = {plans[name].bound_to: listener for name, listener in self.listeners.items()}
        self._senders = {to.name: (_destination(to), senders[to.name]) for to in program.senders}
        for name, listener in self.listeners.items():
            self._drops.follow(name, listener.kernel_drops)

    def prepare(self, program: Program) -> SocketChange:
        """Open the sockets of `program` that are not open yet. Raises StartError or OSError with nothing changed."""
        with ExitStack() as opening:
            listeners = {}
            for plan in program.listeners:
                listener = self._bound.get(plan.bound_to)
                if listener is None or listener.is_replaceable():
                    listener = Listener(plan, has_senders=plan.address.value.port in self._sending_ports())
                    opening.callback(listener.close)
                if listener.lacks_network():
                    _log_absence(plan)
                listeners[plan.name] = listener
            senders: dict[str, NativeSender] = {}
            moves = []
            every = [each.opened for each in (*self._bound.values(), *listeners.values())]
            for to in program.senders:
                name = sent_from(program.table, to)
                source = placed(listeners.get(name) if name is not None else None, listeners.values())
                beside = source.opened if source is not None else None
                destination, sender = self._senders.get(to.name, (None, None))
                is_new = sender is None or destination != _destination(to)
                _check_reachable(to, is_new)
                if sender is None or is_new:
                    opened = open_sending(to, source, every)
                    sender = NativeSender(self._library, to.address.value, opened, beside)
                    opening.callback(sender.close)
                elif not sender.is_placed(beside, every):
                    opened = open_sending(to, source, every)
                    opening.callback(opened.close)
                    moves.append((sender, beside, opened))
                _check_source(to, sender)
                senders[to.name] = sender
            return SocketChange(program, listeners, senders, moves, opening.pop_all())

    def _sending_ports(self) -> set[int]:
        """Return the ports that a listener and a sender share."""
        senders = [sender for _, sender in self._senders.values()]
        return {sender.source.address[1] for sender in senders if sender.source is not None and sender.is_bound}

    def unused_listeners(self, change: SocketChange) -> list[Listener]:
        """Return the listeners that the change does not use."""
        return [each for each in self._bound.values() if each not in change.listeners.values()]

    def apply(self, change: SocketChange) -> None:
        """Replace the sockets with those of the change."""
        for listener in self.unused_listeners(change):
            change.unused.callback(listener.close)
        for endpoint, (_, sender) in self._senders.items():
            if change.senders.get(endpoint) is not sender:
                change.unused.callback(sender.close)
        for sender, source, opened in change.moves:
            change.unused.callback(sender.move(source, opened).close)
        self._follow_drops(change)
        plans = {plan.name: plan for plan in change.program.listeners}
        for name, listener in change.listeners.items():
            listener.follow(plans[name])
        self.listeners = change.listeners
        self._bound = {plans[name].bound_to: listener for name, listener in change.listeners.items()}
        self._senders = {to.name: (_destination(to), change.senders[to.name]) for to in change.program.senders}

    def close_listeners(self) -> None:
        for listener in self.listeners.values():
            listener.close()

    def close_senders(self) -> None:
        for _, sender in self._senders.values():
            sender.close()

    def _follow_drops(self, change: SocketChange) -> None:
        moved = {name for name, each in self.listeners.items() if change.listeners.get(name) is not each}
        for name in moved:
            self._drops.unfollow(name)
        known = self._bound.values()
        for name, listener in change.listeners.items():
            if self.listeners.get(name) is not listener:
                since = listener.kernel_drops() if listener in known else 0
                self._drops.follow(name, listener.kernel_drops, since=since)
