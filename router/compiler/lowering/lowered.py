"""The routines of a table, as the carrier executes them (`native/operations.h`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from router.compiler.checked import Target
from router.compiler.lowering.layout import Layout
from router.compiler.lowering.messages import Place
from router.compiler.lowering.operations import Routine
from router.declared import Scalar


@dataclass(frozen=True, slots=True)
class LoweredCollect:
    """`collect`: routines for the identity of a datagram's frame, its size, and the datagram's position in it.

    All return integers, except `by` if `is_text`. `signs` tells whether `count` and `order` are unsigned. A complete
    frame is put into the slots `items` and `counted`, which are NONE if unused.
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
    """The targets of a route by name, and the fields that they read. Slots 0 and 1 are `received_at` and `source`."""

    targets: Mapping[str, Target]
    layout: Layout
    collect: LoweredCollect | None = None


@dataclass(frozen=True, slots=True)
class LoweredElements:
    """`for_each`: `routine` pushes a list, stored as `scalar` specifies.

    Each element is read into `section` if it is a message, else into the slot `item`. Unused numbers are NONE.
    """

    routine: Routine
    scalar: Scalar
    section: int
    item: int
    index: int
    count: int


@dataclass(frozen=True, slots=True)
class LoweredFeed:
    """A route's routines for the messages of one topic, which are urgent if they expire, or feed or disarm a deadman.

    A state that the topic sets has one without targets, with the state's label as the `route`. `stamp` are the slots of
    seconds and nanoseconds of the message's stamp, or None.
    """

    route: str
    is_urgent: bool
    targets: Mapping[str, Target]
    layout: Layout
    stamp: tuple[int, int] | None
    for_each: LoweredElements | None


@dataclass(frozen=True, slots=True)
class LoweredCondition:
    """A condition on a payload, and the fields that it reads. Slots are those of a LoweredRoute."""

    routine: Routine
    layout: Layout


@dataclass(frozen=True, slots=True)
class LoweredState:
    """What computes the value of a state from a message, and the fields that it reads; `place` is its place.

    `stamp` is as in LoweredFeed.
    """

    routine: Routine
    layout: Layout
    place: str
    stamp: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class LoweredOrder:
    """The number of `order`, the fields that it reads, and how it wraps around. Slots are those of a LoweredRoute."""

    routine: Routine
    layout: Layout
    bits: int
    is_unsigned: bool


@dataclass(frozen=True, slots=True)
class LoweredConstant:
    """The routine of a message that reads no other one, with the place of each operation."""

    routine: Routine
    layout: Layout
    places: tuple[Place, ...]


@dataclass(frozen=True, slots=True)
class Lowered:
    """All routines of a table.

    For datagrams, by route: `to_destinations` has the destinations with a condition, `to_topics` the topics. `from_ros`
    is by topic, in the order of the table. `order` has the numbers of routes with `order`. `obeyed` has the conditions
    that show that a deadman's brake is obeyed, by the deadman's route. `states` is by name. `replies` has the replies
    of routes with `reply`.
    """

    to_destinations: Mapping[str, LoweredRoute]
    to_topics: Mapping[str, LoweredRoute]
    from_ros: Mapping[str, tuple[LoweredFeed, ...]]
    order: Mapping[str, LoweredOrder]
    obeyed: Mapping[str, LoweredCondition]
    states: Mapping[str, LoweredState]
    replies: Mapping[str, LoweredRoute]
