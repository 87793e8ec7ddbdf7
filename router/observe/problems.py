"""The problems that a router can have: the kinds with level, words and remedy, and a problem as JSON.

Imports neither compiler nor protobuf, so that `router status` starts fast.
"""

from __future__ import annotations

import enum
import string
from collections.abc import Mapping
from typing import Any, NamedTuple

PAGE = "docs/troubleshooting/alerts.md"
"""Has a section for each kind."""


class Level(enum.Enum):
    """CRITICAL: the rover may not obey. WARNING: something is lost. INFO: something differs from the table.

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
    """A kind of problem, in the order in which they are shown: what stops the rover, its causes, other losses.

    `words` contain labels of `metric`. There is a problem while its value exceeds `threshold`: for losses per second,
    for times in seconds. `remedy` can also contain the `{address}` of what the labels name, and that address without
    a zone, `{host}`.
    """

    def __init__(self, level: Level, words: str, remedy: str = "", metric: str = "", threshold: float = 0.0) -> None:
        self.level, self.words, self.remedy, self.metric, self.threshold = level, words, remedy, metric, threshold

    def remedy_at(self, address: str) -> str:
        """Return the remedy for what has an address."""
        return self.remedy.format(address=address, host=address.partition("%")[0])

    ROUTER_DOWN = (Level.CRITICAL, "no router answers at {instance}")
    RECEIVE_STUCK = (
        Level.CRITICAL,
        "the receive thread is stuck",
        "Run `systemctl restart rover-router`, then report it with the log.",
        "",
        2.0,  # without datagrams it makes progress every half second
    )
    LISTENER_WAITING = (
        Level.CRITICAL,
        "{listener} receives nothing: its address or network interface does not exist",
        "Bring up the network of {address}, or correct `listen`; `ip -br address` shows what exists.",
        "listener_waiting",
    )
    GROUP_NOT_JOINED = (
        Level.CRITICAL,
        "{listener} has not joined all of its multicast groups",
        "Bring its network up, add a route to the group, or give {listener} an `interface`; `router doctor` names it.",
        "groups_not_joined",
    )
    ENDPOINT_UNRESOLVED = (
        Level.CRITICAL,
        "{endpoint} gets nothing: its host name is not resolved",
        "Check the name with `getent ahosts {address}`, or give {endpoint} its IP address.",
        "endpoint_unresolved",
    )
    LINK_CLOSED = (
        Level.CRITICAL,
        "the link to {endpoint} is closed: nothing is received or sent",
        "Check plug and power, and who has {address}: `ls -lL {address}`, `fuser -v {address}`; the log says why.",
        "link_up",
    )
    DEADMAN_CANNOT_SEND = (
        Level.CRITICAL,
        "the deadman of {route} cannot reach {destination}",
        "Stop the rover by other means. Check power and cable of {destination}, and the firewall for {address}.",
        "deadman_send_errors",
    )
    DEADMAN_DISOBEYED = (
        Level.CRITICAL,
        "{endpoint} does not obey the brake of {route}",
        "Stop the rover by other means. Check that its firmware executes this; `router explain {route}` has `obeyed`.",
        "deadman_disobeyed",
    )
    DEADMAN_ACTIVE = (
        Level.WARNING,
        "{route} is stopped by its deadman: no commands get through",
        "Check that they are sent, and more often than the deadman's `timeout`: `router explain` says who sends them.",
        "deadman_active",
    )
    ENDPOINT_SILENT = (
        Level.WARNING,
        "{endpoint} is silent",
        "Check its power, cable or radio, and address: `ping {address}`, `tcpdump -n udp and host {host}`.",
        "endpoint_silence_seconds",  # the threshold is the endpoint's `stale_after`
    )
    COMMANDS_DROPPED = (
        Level.CRITICAL,
        "commands for {target} are dropped: {reason}",
        "",
        "messages_dropped",
        0.05,
    )
    COMMANDS_MISTYPED = (
        Level.CRITICAL,
        "commands on {topic} are lost: it has a {peer} of {type}",
        "Give that {peer} the table's type, or stop it; `ros2 topic info -v {topic}` names its node.",
        "type_incompatible",
    )
    OTHER_ROUTER = (
        Level.WARNING,
        "another router interferes with this one: process {process} on {host}",
        "Stop one of them: each brakes the rover when it starts and stops. If both are needed, separate their topics.",
        "other_routers",
    )
    PUBLISH_STALLED = (
        Level.WARNING,
        "publishing on {topic} is stuck in the ROS middleware",
        "A subscriber was killed or has its own /dev/shm: set FASTDDS_BUILTIN_TRANSPORTS=UDPv4. Forwarding continues.",
        "publish_stalled_seconds",
        1.0,  # of all calls together
    )
    RELOAD_FAILED = (
        Level.WARNING,
        "the last reload failed; the old table is still running",
        "Run `router validate`, correct what it reports, and reload.",
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
        "Run `router top`: the computer is overloaded, or the ROS middleware blocks the thread.",
        "messages_waiting",
        20,  # of all targets together, in each snapshot; where much is published, there are always a few
    )
    KERNEL_DROPS = (
        Level.WARNING,
        "the kernel drops datagrams of {listener}",
        "Raise its `receive_buffer`, or find what uses the CPU: `router top --once --sort rate`.",
        "kernel_drops",
    )
    DATAGRAMS_REJECTED = (
        Level.WARNING,
        "{listener} rejects datagrams: {reason}",
        "",
        "datagrams_rejected",
        0.05,
    )
    MEMBERS_SUPERSEDED = (
        Level.WARNING,
        "{listener} receives datagrams with several payloads, of which only the last one counts",
        "Send each payload in a datagram of its own; the log names the senders and the payloads.",
        "superseded_members",
        0.05,
    )
    UNHANDLED_CASE = (
        Level.WARNING,
        "{payload_case} is received, but no route accepts it",
        "Write a route for it, or `ignore: reason`; `router tap` shows it.",
        "unhandled",
    )
    QOS_INCOMPATIBLE = (
        Level.WARNING,
        "nothing passes between {topic} and peers with another {policy}",
        "Compare their QoS (`ros2 topic info -v {topic}`) with the router's (`router explain {route}`).",
        "qos_incompatible",
    )
    TYPE_INCOMPATIBLE = (
        Level.WARNING,
        "{topic} has a {peer} of {type}",
        COMMANDS_MISTYPED[2],
        "type_incompatible",
    )
    NODE_NAME_TAKEN = (
        Level.WARNING,
        "another node is called {node}, as this router is",
        "Stop it, or give one of them another name: `node: {{name: ...}}`, or `-r __node:=...` after `--ros-args`.",
        "node_namesakes",
    )
    GATEWAY_DISCONNECTED = (
        Level.WARNING,
        "gateway {route} is not connected to its Zenoh router",
        "Check that the hub runs and that `connect` is reachable; the log has the error.",
        "gateway_connections",
    )
    RECORDING_UNSAVED = (
        Level.WARNING,
        "the recording of a stop is only in memory: {reason}",
        "",
        "recordings_unsaved",
    )
    RECORDING_INCOMPLETE = (
        Level.WARNING,
        "recordings or taps are missing datagrams",
        "Run `df` and `router doctor`: the disk is full or too slow, or the computer is too busy.",
        "record_dropped",  # and mirror_dropped, recordings_lost
    )
    ENDPOINT_NEVER_HEARD = (
        Level.INFO,
        "{endpoint} has not been heard since the router started",
        ENDPOINT_SILENT[2],
        "endpoint_unheard_seconds",  # the threshold is the endpoint's `stale_after`
    )
    COMMAND_BURST = (
        Level.INFO,
        "{route} has received a burst of commands after a silence",
        "A radio or switch may have stored them while its link was lost. They look new: switch off its buffer.",
        "messages_received",
    )
    ENDPOINT_RETURNED = (
        Level.INFO,
        "{endpoint} was silent and is back",
        "If nobody restarted it, it may have been reset: check its power, and cable or radio.",
        "endpoint_silences",
    )
    GATEWAY_CLIENT_SLOW = (
        Level.INFO,
        "client {client} of {route} is behind",
        "It gets only the latest values. Give its gateway lower `rates`, or `compression`.",
        "gateway_client_lag_seconds",
        5,
    )
    GATEWAY_TOPIC_NOT_SERVED = (
        Level.INFO,
        "{route} does not serve topics: {state}",
        "",
        "gateway_topics",
    )
    HALTED = (
        Level.CALM,
        "{route} is halted: no commands",
        "Normal while nobody drives; the next command ends it. Otherwise `router explain` says who sends commands.",
        "deadman_active",
        60,  # s; until then it may be a lost link
    )

    @property
    def alert(self) -> str:
        """The name of its alert and of its section on PAGE, for example `EndpointSilent`."""
        return self.name.title().replace("_", "")

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels in `words`."""
        return tuple(label for _, label, *_ in string.Formatter().parse(self.words) if label)


class Problem(NamedTuple):
    """A problem of a running router. `labels` are those of its metric; `more` gives the amount, which changes.

    `routes`: the routes and gateways whose messages are affected.
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
        """Return the problem with this `json()`. Raises KeyError if it is not the JSON of a problem."""
        kind = {kind.alert: kind for kind in Kind}[read["kind"]]
        labels = {label: str(read["labels"][label]) for label in {*kind.labels, *read["labels"]}}
        return cls(kind, labels, read["more"], read["remedy"], tuple(read["routes"]))


DROPS = (Kind.COMMANDS_DROPPED, Kind.MESSAGES_DROPPED)
"""Losses of targets."""
