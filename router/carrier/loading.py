"""Loads images: opens what their symbols name, or finds it by key among the objects of the image before.

A start loads the image of an earlier process with this module, so it imports only small ones.
"""

from __future__ import annotations

import ctypes

from router import declared as c
from router.carrier.deadmen import NativeDeadman, open_deadman, replaced, successors
from router.carrier.owned import OwnedPointer, open_native
from router.net.addresses import know

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator, Mapping
    from socket import socket
    from typing import Any, Protocol

    from router.image.image import Image, Symbol

    class Addressed(Protocol):
        """An open object with a C structure at `address`. Compared by identity."""

        def __hash__(self) -> int: ...

        @property
        def address(self) -> int: ...

    class Publication(Addressed, Protocol):
        """The protocol of `ros.endpoints.Publication`. Several threads may publish at once, until it is closed."""

        @property
        def demand(self) -> c.Demand: ...

    class Listening(Protocol):
        """A listener: `net.sockets.ListeningSocket`, or what has one."""

        @property
        def is_inherited(self) -> bool: ...

        @property
        def socket(self) -> socket: ...


_WORD = 8
_WANTED, _UNWANTED = c.Demand(wanted=c.Wanted.EVERY_MESSAGE), c.Demand()
"""The demand of a topic that is not open: serving late joiners, it gets its messages later."""


class LoadedImage:
    """An image in memory, with the objects that it needs. Threads may execute it as long as it lives.

    `senders` are by endpoint, without those of links; `timers` is the group of the deadmen of routes, `generation` the
    number of the program. Objects with the same key are those of the image `before`: then both use the same object,
    whichever runs. Topics are bound later, by `bind_topics`. Raises MemoryError.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        image: Image,
        senders: Mapping[str, Addressed],
        timers: int,
        generation: int,
        before: LoadedImage | None = None,
    ) -> None:
        self.image = image
        self.generation = generation
        self.deadmen: dict[str, NativeDeadman] = {}
        self.client_deadmen: dict[str, NativeDeadman] = {}
        self._library = library
        self._memory = (ctypes.c_uint64 * (len(image.memory) // _WORD + 1))()
        self._base = ctypes.addressof(self._memory)
        self._objects: dict[Symbol, Addressed] = {("sender", name): sender for name, sender in senders.items()}
        self._groups = {("timers",): timers}
        self._opened: dict[Hashable, Addressed] = {}
        self._topic_change: c.PublishChange | None = None
        self._before = before._opened if before is not None else {}
        self._places = {image.symbols[number]: words for number, words in image.imports}
        self._copy()
        for host in image.hosts:
            know(library, host)
        is_simulated = any(("sender", name) in self._objects for name, _ in image.link_ends)
        for opening in image.openings:
            if not opening[-1] and not (is_simulated and opening[1] == "server_open"):
                self._open(*opening)
        for symbol in self._places:
            self._set(symbol, self._address(symbol))
        for topic, serves_late_joiners in image.topics:
            self._set(("demand", topic), ctypes.addressof(_WANTED if serves_late_joiners else _UNWANTED))
        self.program = self.at(c.Program, image.program)

    def _copy(self) -> None:
        image, words = self.image, memoryview(self._memory).cast("B").cast("Q")
        ctypes.memmove(self._base, image.memory, len(image.memory))
        for word in image.relocations:
            words[word] += self._base
        halves = memoryview(self._memory).cast("B").cast("I")
        for at in image.generations:
            halves[at // 4] = self.generation

    # objects

    def _open(
        self, symbol: Symbol, function: str, arguments: tuple[Any, ...], of: tuple[Any, ...], of_clients: bool
    ) -> None:
        """Open an object, or find it in the image before."""
        if symbol in self._objects:
            return  # a link that is simulated
        key = symbol, function, self._key(arguments), self._key(of)
        if key not in self._opened:
            self._opened[key] = self._before[key] if key in self._before else self._new(function, arguments)
        self._objects[symbol] = self._opened[key]
        name = symbol[1]
        if isinstance(opened := self._opened[key], NativeDeadman) and name is not None:
            (self.client_deadmen if of_clients else self.deadmen)[name] = opened

    def _key(self, values: tuple[Any, ...]) -> tuple[Hashable, ...]:
        """Return values with symbols replaced by the objects themselves."""
        return tuple(self._key_of(value) if isinstance(value, tuple) else value for value in values)

    def _key_of(self, value: tuple[Any, ...]) -> Hashable:
        if not _is_symbol(value):
            return self._key(value)
        symbol = self.image.symbols[value[0]]
        found: Hashable = self._objects.get(symbol, symbol)
        return found

    def _new(self, function: str, arguments: tuple[Any, ...]) -> Addressed:
        if function == "deadman_open":
            outlets = [self.image.symbols[each[1][0]] for each in arguments[-1]]
            names, objects = [str(name) for _, name in outlets], [self._objects[each] for each in outlets]
            sequences = [self._objects.get(self.image.symbols[each[-2][0]]) for each in arguments[-1] if each[-2]]
            return open_deadman(self._library, arguments, self._argument, names, objects, sequences)
        used = [self._objects.get(self.image.symbols[value[0]]) for value in arguments if _is_symbol(value)]
        address = open_native(self._library, function, *map(self._argument, arguments))
        return OwnedPointer(getattr(self._library, function.removesuffix("_open") + "_close"), address, used)

    def _argument(self, value: Any) -> Any:
        return self._address(self.image.symbols[value[0]]) if _is_symbol(value) else value

    def _address(self, symbol: Symbol) -> int:
        """Return the address of an object; 0 if it is not open yet."""
        if symbol in self._groups:
            return self._groups[symbol]
        return self._objects[symbol].address if symbol in self._objects else 0

    def _set(self, symbol: Symbol, address: int) -> None:
        """Set the address of a symbol wherever the memory refers to it."""
        for word in self._places.get(symbol, ()):
            self._memory[word] = address

    def bind_topics(self, publications: Mapping[str, Publication]) -> None:
        """Set the publishers of topics, by topic, before any thread publishes on them."""
        for topic, _ in self.image.topics:
            if topic in publications:
                self._objects["publisher", topic] = publications[topic]
                self._set(("publisher", topic), publications[topic].address)
                self._set(("demand", topic), ctypes.addressof(publications[topic].demand))

    def open_client_deadmen(self, timers: int) -> None:
        """Open the deadmen of gateway clients in this group, once their topics are bound. Raises MemoryError."""
        self._groups["client timers",] = timers
        for opening in self.image.openings:
            if opening[-1]:
                self._open(*opening)

    def bind_listeners(self, listeners: Mapping[str, Listening]) -> None:
        """Set the sockets of the listeners, by name. Those that are links have none."""
        names = [name for name, *_ in self.image.listeners]
        if names:
            array = (c.Listener * len(names)).from_address(self._base + self.image.listener_array)
            for structure, name in zip(array, names, strict=True):
                structure.fd, structure.keeps_input = listeners[name].socket.fileno(), listeners[name].is_inherited

    def stop_links(self) -> None:
        """Close all links, after what was sent has left. Nothing can be sent through them afterwards."""
        for name in self.image.servers:
            self._library.server_stop(self._objects["server", name].address)
        for endpoint, _ in self.image.link_ends:
            self._library.link_stop(self._objects["sender", endpoint].address)

    def forget_before(self) -> None:
        """Free what only the image before used, once no thread executes it."""
        self._before = {}

    def close(self) -> None:
        """Free the objects, once no thread executes the image. It can no longer be used."""
        self._objects, self._opened, self._before = {}, {}, {}
        self.deadmen, self.client_deadmen = {}, {}

    # structures

    def at(self, kind: Any, offset: int) -> Any:
        """Return a pointer to a structure."""
        return ctypes.pointer(kind.from_address(self._base + offset))

    def states(self, now: int) -> list[c.StateContent]:
        """Return the values of the program's states at `now` (boot clock); none once the image is closed."""
        objects, program = self._objects, self.program.contents  # `objects` keeps the states open
        contents = [c.StateContent() for _ in range(program.state_count if objects else 0)]
        for index, content in enumerate(contents):
            self._library.state_read(ctypes.byref(program.states[index]), now, ctypes.byref(content))
        return contents

    def ros_routes(self) -> Iterator[tuple[str, ctypes.Array[c.RosRoute], bool]]:
        """Yield the topics from ROS, each with its routes, and whether one of them is urgent."""
        for topic, offset, count, is_urgent in self.image.ros_topics:
            yield topic, (c.RosRoute * count).from_address(self._base + offset), is_urgent

    def requests(self) -> dict[str, ctypes.Array[c.RosRoute]]:
        """Return the route of the requests of each service."""
        return {label: (c.RosRoute * 1).from_address(self._base + offset) for label, offset in self.image.requests}

    def timers(self, before: LoadedImage | None = None, ended: Iterable[int] = (), *, of_topics: bool) -> c.TimerChange:
        """Return the changes to the timers of topics or of endpoints when this image replaces the one before.

        Timers that only the image before had end first, then those in `ended`. A pacer ends before its deferrals, and
        deadmen end last.
        """
        adopted = [
            c.Adoption(timer=self._timer(timer), to=self._at(c.Targets, to), target=self._at(c.Target, target))
            for timer, is_topic, to, target in self.image.timers
            if is_topic is of_topics
        ]
        now = {*self._timers(of_topics=of_topics)}
        left = [each for each in (before._timers(of_topics=of_topics) if before else ()) if each not in now]
        left += ended
        return c.TimerChange(
            adopted=(c.Adoption * len(adopted))(*adopted),
            ended=(ctypes.c_void_p * len(left))(*left),
            adopted_count=len(adopted),
            ended_count=len(left),
        )

    def _timers(self, *, of_topics: bool) -> Iterator[int]:
        symbols = self.image.symbols
        yield from (self._address(symbols[timer]) for timer, is_topic, *_ in self.image.timers if is_topic is of_topics)

    def _timer(self, number: int) -> Any:
        return ctypes.pointer(c.Timer.from_address(self._address(self.image.symbols[number])))

    def _at(self, kind: Any, offset: int | None) -> Any:
        return None if offset is None else self.at(kind, offset)

    def change(self, before: LoadedImage | None = None, ended: Iterable[int] = ()) -> c.Change:
        """Return the change of the receive thread to this image. Deadmen take the state of those that they replace."""
        pairs: list[tuple[NativeDeadman, NativeDeadman]] = []
        if before is not None:
            routes = successors(self.image.deadmen, before.image.deadmen)
            pairs = replaced(self.deadmen, before.deadmen, routes)
        addresses = [deadman.address for pair in pairs for deadman in pair]
        return c.Change(
            program=self.program,
            replaced=(ctypes.c_void_p * len(addresses))(*addresses),
            timers=self.timers(before, ended, of_topics=False),
            replaced_count=len(pairs),
        )

    def topic_change(self, before: LoadedImage | None = None) -> c.PublishChange:
        """Return the change of the publish thread to this image, which keeps it alive."""
        self._topic_change = c.PublishChange(timers=self.timers(before, of_topics=True), generation=self.generation)
        return self._topic_change


def _is_symbol(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 1 and isinstance(value[0], int)
