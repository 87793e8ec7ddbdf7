"""Messages from ROS that native threads take, convert and send: neither Python nor a publisher can hold them up."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Lock
from time import sleep
from typing import Protocol

from router.carrier import structures as c
from router.carrier.program import Outlets, native_destination
from router.carrier.ring import Ring
from router.compiler.commands import NO_SLOT, Command, CommandTarget, WriteOp
from router.compiler.program import Handler, Program
from router.threads import StuckError

_IN_TRANSIT_S = 0.01
"""Within this time a message that one of two subscriptions has got reaches the other one as well."""


class Subscription(Protocol):
    """What `ros.receiving.RawSubscription` is. A message is taken by one thread alone."""

    @property
    def address(self) -> int: ...

    @property
    def capacity(self) -> int: ...

    def announce_to(self, eventfd: int | None) -> None: ...

    def take_all(self) -> Sequence[object]: ...


@dataclass(slots=True)
class NativeCommands:
    """The routes of each topic, an array of `struct command_route`, with all that they refer to.

    `urgent` are the topics of which one route is.
    """

    topics: dict[str, ctypes.Array[c.CommandRoute]] = field(default_factory=dict)
    urgent: set[str] = field(default_factory=set)
    arrays: list[object] = field(default_factory=list)

    def only(self, *, urgent: bool) -> NativeCommands:
        """Those for the thread of urgent messages, or those for the other one."""
        topics = {topic: routes for topic, routes in self.topics.items() if (topic in self.urgent) is urgent}
        return NativeCommands(topics, self.urgent, self.arrays)


def native_commands(program: Program, outlets: Outlets) -> NativeCommands:
    """Make the arrays of all topics that the carrier takes. `outlets` serve the targets of routes from ROS, too."""
    made = NativeCommands()
    for topic, commands in program.commands.items():
        handlers = {handler.route: handler for handler in program.outbound[topic]}
        writer = _Writer(program, outlets, made.arrays, topic)
        routes = [writer.route(handlers[command.route], command) for command in commands]
        made.topics[topic] = (c.CommandRoute * len(routes))(*routes)
        if any(command.is_urgent for command in commands):
            made.urgent.add(topic)
    return made


@dataclass(frozen=True, slots=True)
class _Writer:
    program: Program
    outlets: Outlets
    arrays: list[object]
    topic: str

    def route(self, handler: Handler, command: Command) -> c.CommandRoute:
        counters = self.program.counters
        targets = [self._target(handler, target) for target in command.targets]
        made = native_reads(command)
        made.ttl = handler.ttl or 0
        made.targets, made.target_count = (c.CommandTarget * len(targets))(*targets), len(targets)
        made.id = self.outlets.names.number(handler.route)
        made.received = counters.index("messages_received", handler.route, self.topic)
        made.last_message = counters.index("route_last_message_timestamp_seconds", handler.route)
        made.duration = counters.index("route_duration_seconds", handler.route)
        self.arrays.append(made)
        return made

    def _target(self, handler: Handler, target: CommandTarget) -> c.CommandTarget:
        (plan,) = (plan for plan in handler.targets if plan.label == target.label)
        made = native_writes(target)
        made.destination = native_destination(self.program, self.outlets, self.arrays, handler, plan)
        counters = self.program.counters
        made.mapping_error = counters.index("messages_dropped", handler.route, target.label, "mapping_error")
        self.arrays.append(made)
        return made


def native_reads(command: Command) -> c.CommandRoute:
    """A route with its first program only."""
    ops = [c.ReadOp(op.kind, op.size, op.slot, op.elements) for op in command.reads]
    seconds, nanoseconds = command.stamp or (NO_SLOT, NO_SLOT)
    return c.CommandRoute(
        reads=(c.ReadOp * len(ops))(*ops), read_count=len(ops), seconds=seconds, nanoseconds=nanoseconds
    )


def native_writes(target: CommandTarget) -> c.CommandTarget:
    """A target with its second program only."""
    literals = bytearray()
    ops = list(_write_ops(target.writes, literals))
    text = ctypes.create_string_buffer(bytes(literals))
    return c.CommandTarget(writes=(c.WriteOp * len(ops))(*ops), literals=text, write_count=len(ops))


def _write_ops(writes: Sequence[WriteOp], literals: bytearray) -> Iterator[c.WriteOp]:
    for op in writes:
        yield c.WriteOp(
            kind=op.kind,
            scalar=op.scalar,
            encoding=op.encoding,
            flags=op.flags,
            slot=op.slot,
            tag=op.tag,
            least=op.least,
            most=op.most,
            start=len(literals),
            count=len(op.literal),
        )
        literals += op.literal


@dataclass(frozen=True, slots=True)
class _Served:
    """What the thread serves, and the eventfd of each subscription. `structure` refers to `topics`."""

    commands: NativeCommands
    subscriptions: Mapping[str, Subscription]
    eventfds: Mapping[Subscription, int]
    topics: ctypes.Array[c.CommandTopic]
    structure: c.CommandSet


class CommandThread:
    """Takes the messages of subscriptions, and sends what they command. It starts at once, and stops once.

    `deadmen` is the address of the carrier's, `counters` the array that the thread counts in. `take` and `reset` are
    addresses of functions: those of `ros.receiving`. A thread for urgent messages runs before others.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        deadmen: int,
        counters: ctypes.Array[ctypes.c_int64],
        events: Ring,
        take: int,
        reset: int,
        *,
        is_urgent: bool = True,
    ) -> None:
        """Raises MemoryError, also for a lack of descriptors or threads."""
        self._library = library
        self._counters, self._events = counters, events
        self._served: _Served | None = None
        self._in_use = Lock()  # for those who read counters while the thread may be stopped
        self._address: int = library.commands_open(deadmen, counters, events.address, take, reset, is_urgent)
        if not self._address:
            raise MemoryError("the thread for commands from ROS cannot be started")

    @property
    def failures(self) -> int:
        """How often the middleware refused to hand out a message."""
        with self._in_use:
            return int(self._library.commands_failures(self._address)) if self._address else 0

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two messages."""
        copy = (ctypes.c_int64 * count)()
        with self._in_use:
            if not self._address:
                return list(self._counters[:count])
            self._library.commands_counters(self._address, copy, count)
        return list(copy)

    def serve(self, commands: NativeCommands, subscriptions: Mapping[str, Subscription]) -> None:
        """Serve the topics of `commands` from these subscriptions, and no others: between two messages.

        What has arrived on subscriptions that are left is served before; they may be closed afterwards. Where another
        subscription takes over a topic, a command that comes meanwhile may be sent twice. Raises StuckError after 1 s,
        OSError or one of `ros.node.RCL_ERRORS`, with nothing changed.
        """
        earlier = self._served
        eventfds = dict(earlier.eventfds) if earlier else {}
        with ExitStack() as adding:
            for subscription in subscriptions.values():
                if subscription not in eventfds:
                    eventfds[subscription] = eventfd = self._watched(subscription)
                    adding.callback(self._leave, subscription, eventfd)
            if earlier:
                forget_what_is_served(earlier.subscriptions, subscriptions)
            served = _served(commands, subscriptions, {each: eventfds[each] for each in subscriptions.values()})
            if not self._library.commands_serve(self._address, ctypes.byref(served.structure)):
                raise StuckError("the thread for commands from ROS is stuck in the middleware: try again")
            adding.pop_all()
        self._served = served
        for subscription in eventfds.keys() - served.eventfds.keys():
            self._leave(subscription, eventfds[subscription])

    def stop(self) -> bool:
        """Serve what has arrived, and end.

        Return False if the thread is stuck in the middleware after 1 s: then it is left, and the subscriptions must
        stay open. It feeds and sends nothing any more. Idempotent.
        """
        with self._in_use:
            address, self._address = self._address, 0
        if not address:
            return self not in _left
        if not self._library.commands_stop(address):
            _left.append(self)
            return False
        for subscription, eventfd in (self._served.eventfds if self._served else {}).items():
            subscription.announce_to(None)
            os.close(eventfd)
        return True

    def _watched(self, subscription: Subscription) -> int:
        """Return the eventfd by which the thread learns of new messages."""
        with ExitStack() as opening:
            eventfd = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, eventfd)
            if error := self._library.commands_watch(self._address, eventfd):
                raise OSError(error, os.strerror(error))
            opening.callback(self._library.commands_unwatch, self._address, eventfd)
            subscription.announce_to(eventfd)
            opening.pop_all()
        return eventfd

    def _leave(self, subscription: Subscription, eventfd: int) -> None:
        subscription.announce_to(None)
        self._library.commands_unwatch(self._address, eventfd)
        os.close(eventfd)


_left: list[CommandThread] = []
"""Those that are stuck: what they refer to has to live until the process ends."""


def _served(
    commands: NativeCommands, subscriptions: Mapping[str, Subscription], eventfds: Mapping[Subscription, int]
) -> _Served:
    topics = [
        c.CommandTopic(
            subscription=subscriptions[topic].address,
            routes=routes,
            route_count=len(routes),
            capacity=subscriptions[topic].capacity,
            eventfd=eventfds[subscriptions[topic]],
        )
        for topic, routes in commands.topics.items()
    ]
    array = (c.CommandTopic * len(topics))(*topics)
    return _Served(commands, subscriptions, eventfds, array, c.CommandSet(topics=array, count=len(topics)))


def forget_what_is_served(earlier: Mapping[str, Subscription], later: Mapping[str, Subscription]) -> None:
    """Take from subscriptions that replace others what the earlier ones have got as well, and serve."""
    replacing = [each for topic, each in later.items() if earlier.get(topic, each) is not each]
    for subscription in replacing:
        subscription.take_all()
    if replacing:
        sleep(_IN_TRANSIT_S)
