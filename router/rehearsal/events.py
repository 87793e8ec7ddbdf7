"""What can become of a message in a rehearsal, told from what the router's counters count. Plain data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from router.compiler.metrics import Series


@dataclass(frozen=True, slots=True)
class Event:
    """Something became of a message at `at` (ns of the rehearsal's clock)."""

    at: int


@dataclass(frozen=True, slots=True)
class Received(Event):
    """A route took a message from `source`: an endpoint, `unknown`, or a ROS topic."""

    route: str
    source: str


@dataclass(frozen=True, slots=True)
class Sent(Event):
    """A datagram for an endpoint. `by_deadman`: in the place of the route's commands, which stopped coming."""

    route: str
    endpoint: str
    data: bytes
    by_deadman: bool = False


@dataclass(frozen=True, slots=True)
class Published(Event):
    """CDR bytes for a topic, under the name that the table gives it."""

    route: str
    topic: str
    cdr: bytes


@dataclass(frozen=True, slots=True)
class Dropped(Event):
    """A target did not get a message, for one of counters.DROP_REASONS; `detail` says more where there is more."""

    route: str
    target: str
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Filtered(Event):
    """`when` held a message back from a target, or a frame had the datagram already."""

    route: str
    target: str


@dataclass(frozen=True, slots=True)
class Collected(Event):
    """A datagram joined an open frame of a target."""

    route: str
    target: str


@dataclass(frozen=True, slots=True)
class Rejected(Event):
    """No route took a datagram, for one of counters.REJECT_REASONS."""

    listener: str
    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class DeadmanChanged(Event):
    """A route's deadman tripped, or was released."""

    route: str
    active: bool


_MADE_OF: Mapping[str, Callable[[int, tuple[str, ...], bytes], Event]] = {
    "messages_received": lambda at, labels, _: Received(at, *labels),
    "datagrams_sent": lambda at, labels, data: Sent(at, labels[0], labels[1], data),
    "deadman_datagrams_sent": lambda at, labels, data: Sent(at, labels[0], labels[1], data, by_deadman=True),
    "messages_published": lambda at, labels, data: Published(at, labels[0], labels[1], data),
    "messages_dropped": lambda at, labels, _: Dropped(at, *labels),
    "messages_filtered": lambda at, labels, _: Filtered(at, *labels),
    "messages_collected": lambda at, labels, _: Collected(at, *labels),
    "datagrams_rejected": lambda at, labels, _: Rejected(at, *labels),
}
"""By the metric that is counted; each takes the time, the labels, and the bytes that were handed over last."""


def is_told(series: Series) -> bool:
    """Whether counting this series is an event."""
    return series.metric in _MADE_OF


def event_of(series: Series, at: int, data: bytes) -> Event:
    """The event that counting a series is, at `at`; `data` are the bytes that were handed over for it."""
    return _MADE_OF[series.metric](at, series.labels, data)
