"""The routines of a table, as the carrier executes them (`native/operations.h`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from router.compiler.lowering.layout import Layout
from router.compiler.lowering.operations import Routine
from router.declared import Scalar


@dataclass(frozen=True, slots=True)
class LoweredTarget:
    """The routines of a target: `condition` for its `when`, and `message`, which writes what it gets.

    Without a `when` the condition is empty. A destination from UDP gets the envelope as it was received: its `message`
    is empty. `places` are the places of the table where a message may be refused, by `enum place` in `native/events.h`:
    the topic whose message cannot be read ("" of datagrams, which are checked before), the condition, `for_each` or
    `collect`, and what each operation of `message` fills.
    """

    label: str
    condition: Routine
    message: Routine
    places: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LoweredCollect:
    """`collect`: routines that name the frame of a datagram, its size, and the place of the datagram in it.

    All give integers, but `by` a text if `is_text`. `signs` says whether `count` and `order` are unsigned. A complete
    frame goes to the slots `items` and `counted`, NONE for one that is not used.
    """

    by: Routine
    count: Routine
    order: Routine
    is_text: bool
    signs: int
    items: int
    counted: int


@dataclass(frozen=True, slots=True)
class LoweredRoute:
    """Targets of a route by name, and the fields that they read. Slots 0 and 1 are `received_at` and `source`."""

    targets: Mapping[str, LoweredTarget]
    layout: Layout
    collect: LoweredCollect | None = None


@dataclass(frozen=True, slots=True)
class LoweredElements:
    """`for_each`: `routine` leaves a list on the stack, which is stored as `scalar` says.

    Each element is read into `section` if it is a message, else put into the slot `item`; NONE for what is not used.
    """

    routine: Routine
    scalar: Scalar
    section: int
    item: int
    index: int
    count: int


@dataclass(frozen=True, slots=True)
class LoweredFeed:
    """The routines of a route for the messages of one topic. They are urgent if they expire, feed or disarm a deadman.

    `stamp` are the slots of seconds and nanoseconds of the message's stamp, or None.
    """

    route: str
    is_urgent: bool
    targets: Mapping[str, LoweredTarget]
    layout: Layout
    stamp: tuple[int, int] | None
    for_each: LoweredElements | None


@dataclass(frozen=True, slots=True)
class LoweredCondition:
    """A condition on a payload, and the fields that it reads. Slots are those of a LoweredRoute."""

    routine: Routine
    layout: Layout


@dataclass(frozen=True, slots=True)
class Lowered:
    """All that the carrier runs for a table.

    By route: `to_destinations` has those of datagrams that have a condition, `to_topics` its topics. `from_ros` by
    topic, in the order of the table.
    """

    to_destinations: Mapping[str, LoweredRoute]
    to_topics: Mapping[str, LoweredRoute]
    from_ros: Mapping[str, tuple[LoweredFeed, ...]]
