"""The problems that a router can have: each kind with its level, words and remedy, and one of them as JSON.

`router status` needs no more than this, so it imports neither compiler nor protobuf.
"""

from __future__ import annotations

import enum
import string
from collections.abc import Mapping
from typing import Any, NamedTuple

PAGE = "docs/troubleshooting/alerts.md"
"""It has a section for each kind."""


class Level(enum.Enum):
    """CRITICAL: the rover may not obey. WARNING: something is lost. INFO: something is not as the table has it.

    CALM: nothing is wrong, but the rover stands still.
    """

    CRITICAL = "critical"
    WARNING = "warning"
    INFO = "info"
    CALM = "calm"

    @property
    def is_fault(self) -> bool:
        return self in (Level.CRITICAL, Level.WARNING)


class Kind(enum.Enum):
    """A kind of problem, first those that explain others.

    `words` have labels of `metric`, which is at fault above the `threshold`: losses per second, times in seconds.
    `remedy` may also have the `{address}` of what the labels name.
    """

    def __init__(self, level: Level, words: str, remedy: str = "", metric: str = "", threshold: float = 0.0) -> None:
        self.level, self.words, self.remedy, self.metric, self.threshold = level, words, remedy, metric, threshold

    ROUTER_DOWN = (Level.CRITICAL, "no router answers at {instance}")
    RECEIVE_STUCK = (
        Level.CRITICAL,
        "the receive thread is stuck",
        "`systemctl restart rover-router`, then report it with its log.",
        "",
        2.0,  # without datagrams it makes progress each half second
    )
    LISTENER_WAITING = (
        Level.CRITICAL,
        "{listener} receives nothing: its address or network interface is not there",
        "It waits for {address}; `ip -br address` shows what there is.",
        "listener_waiting",
    )
    DEADMAN_CANNOT_SEND = (
        Level.CRITICAL,
        "{destination} does not get what the deadman of {route} sends",
        "Nobody listens at {address}, or the network refuses it. Stop the rover by other means.",
        "deadman_send_errors",
    )
    COMMANDS_DROPPED = (
        Level.CRITICAL,
        "commands for {target} are dropped: {reason}",
        "",
        "messages_dropped",
        0.05,
    )
    ENDPOINT_SILENT = (
        Level.WARNING,
        "{endpoint} is silent",
        "Check power, cable or radio, and `ping {address}`; `tcpdump -n udp and host {address}` shows what comes.",
        "endpoint_last_seen_timestamp_seconds",  # the threshold is the endpoint's `stale_after`
    )
    DEADMAN_ACTIVE = (
        Level.WARNING,
        "commands of {route} do not get through: its deadman sends in their place",
        "`router explain` says who sends them. Do they come often enough, from a clock that agrees with this one?",
        "deadman_active",
    )
    PUBLISH_STALLED = (
        Level.WARNING,
        "publishing on {topic} is stuck in the ROS middleware",
        "A subscriber may be stuck, or was killed; forwarding and deadmen go on.",
        "publish_stalled_seconds",
        1.0,  # of all calls together
    )
    RELOAD_FAILED = (
        Level.WARNING,
        "the last reload failed: the table from before it goes on",
        "`router validate` says what is wrong with the changed table.",
        "config_last_reload_successful",
    )
    MESSAGES_DROPPED = (
        Level.WARNING,
        "messages for {target} are dropped: {reason}",
        "",
        "messages_dropped",
        0.05,
    )
    MESSAGES_WAITING = (
        Level.WARNING,
        "messages wait for a thread that publishes or sends",
        "The computer is overloaded (`router top`), or the ROS middleware holds a thread.",
        "messages_waiting",
        20,  # at all times, of all targets together; a few are there at each look where much is published
    )
    KERNEL_DROPS = (
        Level.WARNING,
        "the kernel drops datagrams of {listener}",
        "Raise its `receive_buffer`, or find what takes the processor: `router top --once --sort rate`.",
        "kernel_drops",
    )
    DATAGRAMS_REJECTED = (
        Level.WARNING,
        "{listener} rejects datagrams: {reason}",
        "",
        "datagrams_rejected",
        0.05,
    )
    UNHANDLED_CASE = (
        Level.WARNING,
        "{payload_case} is received, and has no route",
        "Write a route for it, or `ignore: reason`; `router tap` shows it.",
        "unhandled",
    )
    QOS_INCOMPATIBLE = (
        Level.WARNING,
        "nothing passes between {topic} and peers with another {policy}",
        "`ros2 topic info -v {topic}` shows theirs, `router explain {route}` ours.",
        "qos_incompatible",
    )
    GATEWAY_DISCONNECTED = (
        Level.WARNING,
        "gateway {route} is not connected to its Zenoh router",
        "Check that the hub runs, and that `connect` can be reached; the log says why it cannot.",
        "gateway_connections",
    )
    RECORDING_INCOMPLETE = (
        Level.WARNING,
        "recordings or taps lack datagrams",
        "The disk is full or too slow, or the computer too busy: `df`, `router doctor`.",
        "record_dropped",  # and mirror_dropped
    )
    ENDPOINT_NEVER_HEARD = (
        Level.INFO,
        "{endpoint} was never heard since the router started",
        ENDPOINT_SILENT[2],
    )
    GATEWAY_CLIENT_SLOW = (
        Level.INFO,
        "client {client} of {route} is behind",
        "It gets the latest values only. Give its gateway smaller `rates`, or `compression`.",
        "gateway_client_lag_seconds",
        5,
    )
    GATEWAY_TOPIC_NOT_SERVED = (
        Level.INFO,
        "types that {route} would need are not installed",
        "`router explain {route} --live` names them: source their packages, or exclude them.",
        "gateway_topics",
    )
    HALTED = (
        Level.CALM,
        "{route} is halted: no commands",
        "Nobody drives; the next command ends it. Otherwise `router explain` says who sends commands.",
        "deadman_active",
        60,  # s; until then nobody knows whether the link was lost
    )

    @property
    def alert(self) -> str:
        """The name of its alert and of its section on PAGE, such as `EndpointSilent`."""
        return self.name.title().replace("_", "")

    @property
    def labels(self) -> tuple[str, ...]:
        """Those in its words."""
        return tuple(label for _, label, *_ in string.Formatter().parse(self.words) if label)


class Problem(NamedTuple):
    """What is wrong (`words`), with labels of its metric; by how much (`more`), which changes; and what to do.

    `routes`: the routes and gateways whose messages it concerns.
    """

    kind: Kind
    labels: Mapping[str, str]
    more: str = ""
    remedy: str = ""
    routes: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        return self.kind.words.format_map(self.labels)

    @property
    def text(self) -> str:
        return self.words + self.more

    @property
    def page(self) -> str:
        return f"{PAGE}#{self.kind.alert.lower()}"

    def json(self) -> dict[str, Any]:
        own = {**self._asdict(), "kind": self.kind.alert, "level": self.kind.level.value}
        return {**own, "words": self.words, "page": self.page}

    @classmethod
    def of(cls, read: Mapping[str, Any]) -> Problem:
        """The one with this `json()`. Raises KeyError where it is not."""
        kind = {kind.alert: kind for kind in Kind}[read["kind"]]
        labels = {label: str(read["labels"][label]) for label in {*kind.labels, *read["labels"]}}
        return cls(kind, labels, read["more"], read["remedy"], tuple(read["routes"]))


DROPS = (Kind.COMMANDS_DROPPED, Kind.MESSAGES_DROPPED)
"""What a target loses."""
