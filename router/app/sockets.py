"""The UDP sockets of a program: opened, kept where the next program wants the same, closed when nobody does."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field

from router.app.accounts import KernelDrops
from router.compiler.program import Program
from router.net.kernel import interface_is_up
from router.net.udp import Listener, Sender
from router.table.addresses import Address


@dataclass(slots=True)
class SocketChange:
    """All sockets of the program that comes: listeners by name, senders by endpoint.

    `opened` closes what was opened for it, `left` what it has no use for, once it is applied.
    """

    program: Program
    listeners: dict[str, Listener]
    senders: dict[str, Sender]
    opened: ExitStack
    left: ExitStack = field(default_factory=ExitStack)


def is_replaceable(listener: Listener) -> bool:
    """Whether its network interface has gone, and another one of the same name is there."""
    return listener.has_lost_interface() and interface_is_up(listener.interface or "") is not None


class Sockets:
    """Listeners by name, and senders by endpoint. Nothing is open before the first change."""

    def __init__(self, drops: KernelDrops) -> None:
        self.listeners: dict[str, Listener] = {}
        self._bound: dict[str, Listener] = {}  # by what tables bind them to
        self._senders: dict[str, tuple[Address, Sender]] = {}
        self._drops = drops

    def prepare(self, program: Program) -> SocketChange:
        """Opens what `program` wants and what is not open; nothing else changes. Raises StartError."""
        table = program.table
        with ExitStack() as opening:
            listeners = {}
            for plan in program.listeners:
                listener = self._bound.get(plan.bound_to)
                if listener is None or is_replaceable(listener):
                    listener = Listener(plan, table.listeners[plan.name].address.span)
                    opening.callback(listener.close)
                listeners[plan.name] = listener
            senders = {}
            for to in program.senders:
                address, sender = self._senders.get(to.endpoint, (None, None))
                if sender is None or address != to.address:
                    sender = Sender(to, table.endpoints[to.endpoint].address.span)
                    opening.callback(sender.close)
                senders[to.endpoint] = sender
            return SocketChange(program, listeners, senders, opening.pop_all())

    def left(self, change: SocketChange) -> list[Listener]:
        """The listeners that nobody listens to after the change."""
        return [each for each in self._bound.values() if each not in change.listeners.values()]

    def apply(self, change: SocketChange) -> None:
        """From now on these are used."""
        for listener in self.left(change):
            change.left.callback(listener.close)
        for endpoint, (_, sender) in self._senders.items():
            if change.senders.get(endpoint) is not sender:
                change.left.callback(sender.close)
        self._follow(change)
        plans = {plan.name: plan for plan in change.program.listeners}
        for name, listener in change.listeners.items():
            listener.follow(plans[name])
        self.listeners = change.listeners
        self._bound = {plans[name].bound_to: listener for name, listener in change.listeners.items()}
        self._senders = {to.endpoint: (to.address, change.senders[to.endpoint]) for to in change.program.senders}

    def close_listeners(self) -> None:
        for listener in self.listeners.values():
            listener.close()

    def close_senders(self) -> None:
        for _, sender in self._senders.values():
            sender.close()

    def _follow(self, change: SocketChange) -> None:
        """Who has which socket now."""
        moved = {name for name, each in self.listeners.items() if change.listeners.get(name) is not each}
        for name in moved:
            self._drops.leave(name)
        known = self._bound.values()
        for name, listener in change.listeners.items():
            if self.listeners.get(name) is not listener:
                since = listener.kernel_drops() if listener in known else 0
                self._drops.follow(name, listener.kernel_drops, since=since)
