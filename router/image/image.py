"""The image of a compiled table. A start reads one before anything else is loaded, so this module imports nothing."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, TypeAlias

    Symbol: TypeAlias = tuple[str | None, ...]
    """What has an address only once it is open: its kind, then its names."""
    Series: TypeAlias = tuple[str, ...]
    """A metric and the values of its labels."""


class Image:
    """A compiled table as memory of the carrier and plain values. Offsets are in bytes, from the start of `memory`.

    The memory can be loaded at any address: the words at `relocations` hold offsets, `imports` lists the words of each
    symbol, and `generations` has the offsets of fields for the number of the program. `program`, `listener_array` and
    the arrays of `ros_topics` (topic, offset, number of routes, whether one is urgent) are structures in it, and so are
    the routes of `requests` to services (service, offset).

    To open, by name: `listeners` (name, address, interface, receive buffer, multicast groups), `senders` (name,
    address, whether it is a board, its cast as in `compiler.network`, listener to send from), and `topics` (name,
    whether late subscribers get messages). `hosts` are IPv6 addresses whose numbers are in the memory. `openings` lists
    the objects to open, in this order: (symbol, function, arguments, what else identifies the object, whether it
    belongs to the clients of gateways). An argument that is a tuple of one number is a symbol. Among them are the links
    of `link_ends` (endpoint, address or device) and the TCP `servers`; in `listener_array`, links follow `listeners`.
    `timers` are adopted: (symbol, whether it is for a topic, offset of its targets, offset of the target). `deadmen`
    and `client_deadmen` are (name, names that it sends to, commands that it watches).

    `names` are the names with a number, `series` the counters with an index, below `counters`. `mirror_lost` is the
    counter of what observers miss; None if nothing is observed from the start.
    """

    memory: bytes
    relocations: list[int]
    imports: list[tuple[int, list[int]]]
    generations: list[int]
    symbols: list[Symbol]
    program: int
    listener_array: int
    ros_topics: list[tuple[str, int, int, bool]]
    requests: list[tuple[str, int]]
    listeners: list[tuple[str, tuple[str, int], str | None, int, tuple[str, ...]]]
    senders: list[tuple[str, tuple[str, int], bool, tuple[str | None, int, bool] | str | None, str | None]]
    link_ends: list[tuple[str, str]]
    servers: list[str]
    topics: list[tuple[str, bool]]
    hosts: list[str]
    openings: list[tuple[Symbol, str, tuple[Any, ...], tuple[Any, ...], bool]]
    timers: list[tuple[int, bool, int | None, int | None]]
    deadmen: list[tuple[str, list[str], list[tuple[str, str]]]]
    client_deadmen: list[tuple[str, list[str], list[tuple[str, str]]]]
    names: list[str]
    series: list[tuple[Series, int]]
    counters: int
    mirror_lost: int | None

    def __init__(self, **parts: Any) -> None:
        self.__dict__.update(parts)

    def parts(self) -> dict[str, Any]:
        """Return everything as plain values for `marshal`."""
        return dict(self.__dict__)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Image) and self.__dict__ == other.__dict__

    __hash__ = None  # type: ignore[assignment]
