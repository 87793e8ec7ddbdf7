"""Random tables for the judge of the stage, and what is handed to their routes."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from router.rehearsal.cdr import serialize
from router.types.model import Bool, Float, Int, List, MessageType, String, Type
from tests.small_tables import enveloped

HEAD = """version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen:
  trimmed: {address: 127.0.0.1:5000, framing: zero_trimmed}
  exact: {address: 127.0.0.1:5001, framing: exact}
endpoints:
"""
ENDPOINTS = {
    "sensor_board": "192.168.0.30:8, kind: board",
    "driving_board": "192.168.0.222:8, kind: board",
    "arm_board": "192.168.0.223:8, kind: board, trim_trailing_zeros: true",
    "basestation": "192.168.0.10:9000, kind: basestation",
    "recorder": "192.168.0.20:9000, kind: tool, trim_trailing_zeros: true",
    "left_tool": "192.168.0.60:7001, kind: tool, source_port: 8001",
    "right_tool": "192.168.0.60:7002, kind: tool, source_port: 8002",
    "picky": "192.168.0.81:9000, kind: tool, listener: exact",
}
PEERS = (
    *2 * (("192.168.0.30", 8),), ("192.168.0.30", 9), ("192.168.0.222", 8), ("192.168.0.223", 8),
    *3 * (("192.168.0.10", 9000),), ("192.168.0.20", 9000), ("192.168.0.60", 8001), ("192.168.0.60", 8002),
    ("192.168.0.60", 8003), ("192.168.0.81", 9000), ("192.168.0.99", 1), ("0.0.0.0", 0), ("255.255.255.255", 65535),
)  # fmt: skip

_SENDERS = ("sensor_board", "basestation", "left_tool", "right_tool", "picky", "recorder")
_BOARDS = ("driving_board", "arm_board")
_OTHERS = ("basestation", "recorder", "left_tool", "right_tool", "picky")
_FIELDS = {
    "imu_info": ("accel_x", "accel_y", "accel_z"),
    "gps_info": ("hdop", "vdop", "speed"),
    "ph_info": ("ph_value",),
    "pressure_info": ("sensor_index", "pressure_kpa"),
    "manual_drive": ("turn", "forward_backward"),
    "manual_arm": (),
    "drive_diag": (),
}
_INTEGERS = ("sensor_index", "turn", "forward_backward", "3")
_COMMANDS = ("manual_drive", "manual_arm", "drive_motor", "arm_target", "arm_ctrl")
_RATES = ("3 Hz", "12 Hz", "30 Hz", "47.5 Hz", "200 Hz")
_TIMES = ("50ms", "120ms", "200ms", "1s")
_BANDWIDTHS = ("300 B/s", "1kB/s", "2kB/s", "20kB/s", "1MB/s")
_FROM_ROS = {
    "drive_motor": ("comms/msg/DrivingBoardMotorMessage", "auto", "distance_to_go", ""),
    "arm_target": ("comms/msg/ArmBoardTargetMovement", "auto", "target_x", ""),
    "arm_ctrl": ("geometry_msgs/msg/TwistStamped", "{control_base: float32(twist.linear.x)}", "twist.angular.z", ""),
    "detected_object": (
        "comms/msg/DetectedObjectArray",
        "{auto: true, frame_id: frame_id, total_count: count, index: index}",
        "item.confidence",
        "for_each: detections, ",
    ),
}
"""By payload case: the type of ROS, the fields, a number to ask for in conditions, and more keys of the route."""


@dataclass(frozen=True)
class RandomTable:
    """A table by its parts, so that another one can differ in some."""

    bandwidths: dict[str, str]
    routes: dict[str, str]
    bearing: frozenset[str] = field(default_factory=frozenset)

    @property
    def text(self) -> str:
        endpoints = "".join(
            f"  {name}: {{address: {rest}{self.bandwidths.get(name, '')}}}\n" for name, rest in ENDPOINTS.items()
        )
        return HEAD + endpoints + "routes:\n" + "".join(self.routes.values())


class Tables:
    """Makes tables by what `noise` says. Some are refused when they are checked."""

    def __init__(self, noise: random.Random) -> None:
        self._noise = noise
        self._commanded: dict[str, list[str]] = {}  # which boards the routes with commands send to
        self._sources: Sequence[str] = ()  # of the route that is made

    def table(self) -> RandomTable:
        return RandomTable(self._bandwidths(), dict(self._routes()))

    def next(self, table: RandomTable) -> RandomTable:
        """A table that differs: in bandwidths, or in some of the routes."""
        if self._noise.random() < 0.2:
            table = replace(table, bandwidths=self._bandwidths())
        others = dict(self._routes())
        routes = {
            name: others.get(name, text) if self._noise.random() < 0.4 else text for name, text in table.routes.items()
        }
        routes = {name: text for name, text in routes.items() if self._noise.random() < 0.9}
        added = {name: text for name, text in others.items() if name not in routes and self._noise.random() < 0.2}
        return replace(table, routes=routes | added)

    def _bandwidths(self) -> dict[str, str]:
        named = [name for name in (*_BOARDS, *_OTHERS) if self._chance(0.25)]
        return {name: f", bandwidth: {self._noise.choice(_BANDWIDTHS)}" for name in named}

    def _chance(self, probability: float) -> bool:
        return self._noise.random() < probability

    def _routes(self) -> Iterator[tuple[str, str]]:
        self._commanded = {
            case: self._noise.sample(_BOARDS, self._noise.randrange(1, 3)) for case in _COMMANDS if self._chance(0.7)
        }
        for case in _FIELDS:
            if case in self._commanded or (case not in _COMMANDS and self._chance(0.75)):
                yield case, self._route(case)
        for case in _FROM_ROS:
            if case in self._commanded or (case not in _COMMANDS and self._chance(0.4)):
                yield case, self._from_ros(case)
        if self._chance(0.4):
            yield "detected_object", self._collected()
        if self._chance(0.2):
            yield "ignored", "  arm_diag: {ignore: nobody wants it}\n"

    def _route(self, case: str) -> str:
        if case in self._commanded:
            return f"  {case}: {self._inbound(case, ['basestation', 'left_tool'])}\n"
        if self._chance(0.3):
            one, other = (self._inbound(case, sources) for sources in (["sensor_board"], ["left_tool", "picky"]))
            return f"  {case}:\n    - {one}\n    - {other}\n"
        sources = ["any"] if self._chance(0.4) else self._noise.sample(_SENDERS, self._noise.randrange(1, 4))
        return f"  {case}: {self._inbound(case, sources)}\n"

    def _inbound(self, case: str, sources: Sequence[str]) -> str:
        self._sources = sources
        parts = [f"source: [{', '.join(sources)}]" if "any" not in sources else "source: any"]
        topics = self._topics(case) if case not in self._commanded else []
        destinations = self._destinations(case, [each for each in _OTHERS if each not in sources], least=not topics)
        parts += [f"destinations: [{', '.join(destinations)}]"] if destinations else []
        parts += [f"topics: [{', '.join(topics)}]"] if topics else []
        return "{" + ", ".join([*parts, *self._age(case), *self._kind()]) + "}"

    def _kind(self) -> list[str]:
        return [f"priority: {self._noise.choice(('command', 'telemetry', 'bulk'))}"] if self._chance(0.3) else []

    def _age(self, case: str) -> list[str]:
        """`ttl` and `deadman`: of a command that may wait, a `ttl` that is shorter than the timeout."""
        timeout, ttl = self._noise.choice(((300, 120), (300, 200), (1000, 400)))
        boards = self._commanded.get(case)
        if boards is None:
            return [f"ttl: {self._noise.choice(_TIMES)}"] if self._chance(0.4) else []
        if self._chance(0.2):
            return [f"ttl: {ttl}ms", "deadman: {none: for tests}"]
        to = self._noise.sample(boards, self._noise.randrange(1, len(boards) + 1))
        others = [each for each in self._commanded if each != case and {*to} & {*self._commanded[each]}]
        disarmed = ", ".join(each for each in others if self._chance(0.5))
        keys = f"timeout: {timeout}ms, repeat: {self._noise.choice(('30ms', '70ms', '110ms', '500ms'))}"
        keys += f", send: {{manual_brake: {{brake: true}}}}, to: [{', '.join(to)}], disarmed_by: [{disarmed}]"
        return [*([f"ttl: {ttl}ms"] if self._chance(0.8) else []), f"deadman: {{{keys}}}"]

    def _destinations(self, case: str, outlets: Sequence[str], *, least: bool) -> list[str]:
        boards = self._commanded.get(case, [])
        count = self._noise.randrange(1 if least and not boards else 0, min(4, len(outlets)) + 1)
        return [self._destination(case, name) for name in (*boards, *self._noise.sample(outlets, count))]

    def _destination(self, case: str, name: str) -> str:
        keys = self._limits() + self._condition(case)
        return f"{{endpoint: {name}{keys}}}" if keys else name

    def _limits(self) -> str:
        if self._chance(0.6):
            return ""
        latest = ", on_limit: latest" if self._chance(0.5) else ""
        return f", max_rate: {self._noise.choice(_RATES)}{latest}"

    def _condition(self, case: str) -> str:
        if self._chance(0.6):
            return ""
        numbers = _FIELDS.get(case, ()) if case not in _FROM_ROS else (_FROM_ROS[case][2],)
        conditions = ['source == "left_tool"'] if {"any", "left_tool"} & {*self._sources} else []
        for each in numbers:
            conditions += [f"{each} > 1", f"1 / {each} > 0.5", f"{each} != 0 or {each} > -5"]
        return f", when: {self._noise.choice(conditions)}" if conditions else ""

    def _topics(self, case: str) -> list[str]:
        named = [(kind, number) for kind in ("Float32", "Int32", "String") for number in (1, 2) if self._chance(0.15)]
        return [self._topic(case, kind, number) for kind, number in named]

    def _topic(self, case: str, kind: str, number: int) -> str:
        keys = f"topic: {kind.lower()}_{number}, type: std_msgs/msg/{kind}, fields: {{data: {self._value(case, kind)}}}"
        return f"{{{keys}{self._limits()}{self._condition(case)}}}"

    def _value(self, case: str, kind: str) -> str:
        number = self._noise.choice(_FIELDS[case] or ("3",))
        if kind == "String":
            return self._noise.choice(("source", f"'text(float64({number}), 1)'"))
        if kind == "Float32":
            values = [f"1 / {number}", f"float32({number} * 2)", f"float32({number} if {number} > 1 else 7)"]
        elif number in _INTEGERS:
            values = [f"floor(1 / {number})", f"int32({number})"]
        else:
            values = [f"round({number} * 1000)", f"floor(1 / {number})", f"round({number})"]
        return self._noise.choice(values)

    def _from_ros(self, case: str) -> str:
        kind, fields, _, more = _FROM_ROS[case]
        self._sources = ()
        destinations = self._destinations(case, ("recorder",) if case in self._commanded else _OTHERS, least=True)
        topic = self._noise.choice((f"{case}_topic", f"{case}_topic", f"shared_{kind.rpartition('/')[2]}"))
        parts = [f"source: {{topic: {topic}, type: {kind}}}", f"{more}fields: {fields}"]
        parts += [f"destinations: [{', '.join(destinations)}]", *self._age(case), *self._kind()]
        return f"  {case}: {{{', '.join(parts)}}}\n"

    def _collected(self) -> str:
        """Frames of detected objects."""
        self._sources = ()
        destinations = self._destinations("detected", ("recorder", "left_tool"), least=False)
        parts = ["source: basestation", *([f"destinations: [{', '.join(destinations)}]"] if destinations else [])]
        timeout = self._noise.choice(("40ms", "200ms", "1s"))
        parts.append(f"collect: {{by: frame_id, count: total_count, order: index, timeout: {timeout}}}")
        parts += ["ttl: 300ms"] if self._chance(0.3) else []
        fields = "{frame_id: frame_id, detections: items}"
        topics = [f"{{topic: objects, type: comms/msg/DetectedObjectArray, fields: {fields}{self._limits()}}}"]
        if self._chance(0.4):
            topics.append("{topic: how_many, type: std_msgs/msg/Int32, fields: {data: count}, when: count > 1}")
        parts.append(f"topics: [{', '.join(topics)}]")
        return f"  detected_object: {{{', '.join(parts)}}}\n"


# what is handed in


def datagram(noise: random.Random) -> bytes:
    """An envelope of one of the cases."""
    value = noise.choice((0.0, 0.0, 1.5, 7.0, 1e-40, 1e30, float("nan"), -2.0))
    small = noise.choice((0, 0, 1, 2, 40))
    payloads: Sequence[dict[str, dict[str, Any]]] = (
        {"imu_info": {"accel_x": value, "accel_y": noise.choice((0.0, 2.0)), "accel_z": value}},
        {"gps_info": {"hdop": value, "vdop": noise.choice((0.0, 3.0))}},
        {"ph_info": {"ph_value": value}},
        {"drive_diag": {}},
        {"arm_diag": {}},
        {"manual_drive": {"turn": small}},
        {"manual_drive": {"forward_backward": small}},
        {"manual_arm": {}},
        {"pressure_info": {"sensor_index": small, "pressure_kpa": value}},
        *2 * ({"detected_object": {"frame_id": noise.randrange(4), "total_count": noise.choice((1, 2, 3, 3)),
                                   "index": noise.randrange(4)}},),
    )  # fmt: skip
    return enveloped(**noise.choice(payloads))


def ros_message(noise: random.Random, kind: MessageType) -> bytes:
    """CDR bytes of a type; now and then cut off."""
    data = serialize(kind, _values(noise, kind))
    return data[: noise.randrange(len(data))] if noise.random() < 0.03 else data


def _values(noise: random.Random, kind: MessageType) -> dict[str, Any]:
    return {each.name: _value(noise, each.type) for each in kind.fields}


def _value(noise: random.Random, kind: Type) -> Any:
    match kind:
        case MessageType():
            return _values(noise, kind)
        case List():
            count = noise.choice((0, 1, 2, 5)) if kind.length is None else kind.length
            return [_value(noise, kind.element) for _ in range(count)]
        case String():
            return noise.choice(("", "a", "somewhat longer"))
        case Bool():
            return noise.random() < 0.5
        case Float():
            return noise.choice((0.0, 1.0, 2.5, -3.0, 1e30, float("nan")))
        case Int():
            return noise.choice((0, 0, 1, 100))
    raise TypeError(kind)
