"""Random tables for the judge of the stage, and what is handed to their routes."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from router.rehearsal.cdr import serialize
from router.types.model import Bool, Float, Int, List, MessageType, String, Type
from tests.engine.test_both_directions import enveloped

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

COLLECTS = False
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
_COMMANDS = ("manual_drive", "manual_arm")
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
        for case in _FIELDS:
            if self._chance(0.75):
                yield case, self._route(case)
        for case in _FROM_ROS:
            if self._chance(0.5):
                yield f"{case} from ROS", self._from_ros(case)
        if COLLECTS and self._chance(0.4):
            yield "collected", self._collected()
        if self._chance(0.2):
            yield "ignored", "  arm_diag: {ignore: nobody wants it}\n"

    def _route(self, case: str) -> str:
        if case in _COMMANDS:
            return f"  {case}: {self._inbound(case, ['basestation', 'left_tool'], _BOARDS, ())}\n"
        if self._chance(0.3):
            one, other = (
                self._inbound(case, sources, _OTHERS, self._topics(case))
                for sources in (["sensor_board"], ["left_tool", "picky"])
            )
            return f"  {case}:\n    - {one}\n    - {other}\n"
        sources = ["any"] if self._chance(0.4) else self._noise.sample(_SENDERS, self._noise.randrange(1, 4))
        outlets = (*_OTHERS, "arm_board") if self._chance(0.2) else _OTHERS
        return f"  {case}: {self._inbound(case, sources, outlets, self._topics(case))}\n"

    def _inbound(self, case: str, sources: Sequence[str], outlets: Sequence[str], topics: Sequence[str]) -> str:
        parts = [f"source: {'any' if list(sources) == ['any'] else '[' + ', '.join(sources) + ']'}"]
        destinations = self._destinations(case, [each for each in outlets if each not in sources], least=not topics)
        parts += [f"destinations: [{', '.join(destinations)}]"] if destinations else []
        parts += [f"topics: [{', '.join(topics)}]"] if topics else []
        parts += self._age(case, destinations)
        parts += self._kind()
        return "{" + ", ".join(parts) + "}"

    def _kind(self) -> list[str]:
        return [f"priority: {self._noise.choice(('command', 'telemetry', 'bulk'))}"] if self._chance(0.3) else []

    def _age(self, case: str, destinations: Sequence[str]) -> list[str]:
        """`ttl` and `deadman`: boards that get commands need one, or a reason for none."""
        parts = [f"ttl: {self._noise.choice(_TIMES)}"] if self._chance(0.4) else []
        boards = [name for name in _BOARDS if any(name in each for each in destinations)]
        if not boards:
            return parts
        if self._chance(0.2):
            return [*parts, "deadman: {none: for tests}"]
        others = [
            each for each in (*_COMMANDS, *_FROM_ROS) if each not in {case, "detected_object"} and self._chance(0.4)
        ]
        disarmed = f"[{', '.join(others)}]"
        keys = (
            f"timeout: {self._noise.choice(_TIMES)}, repeat: {self._noise.choice(('30ms', '70ms', '110ms', '500ms'))}"
        )
        to = self._noise.sample(boards, self._noise.randrange(1, len(boards) + 1))
        keys += f", send: {{manual_brake: {{brake: true}}}}, to: [{', '.join(to)}], disarmed_by: {disarmed}"
        return [*parts, f"deadman: {{{keys}}}"]

    def _destinations(self, case: str, outlets: Sequence[str], *, least: bool) -> list[str]:
        count = self._noise.randrange(1 if least else 0, min(4, len(outlets)) + 1)
        return [self._destination(case, name) for name in self._noise.sample(outlets, count)]

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
        numbers = _FIELDS.get(case, ())
        if case not in _FIELDS:
            numbers = (_FROM_ROS[case][2],)
        conditions = ['source == "left_tool"'] if case in _FIELDS else []
        for each in numbers:
            conditions += [f"{each} > 1", f"1 / {each} > 0.5", f"{each} != 0 or {each} > -5"]
        return f", when: {self._noise.choice(conditions)!s}" if conditions else ""

    def _topics(self, case: str) -> list[str]:
        named = [(kind, number) for kind in ("Float32", "Int32", "String") for number in (1, 2) if self._chance(0.15)]
        return [f"{{topic: {kind.lower()}_{number}, type: std_msgs/msg/{kind}, fields: {{data: {self._value(case, kind)}}}"
                f"{self._limits()}{self._condition(case)}}}" for kind, number in named]  # fmt: skip

    def _value(self, case: str, kind: str) -> str:
        number = self._noise.choice(_FIELDS[case] or ("3",))
        if kind == "String":
            return self._noise.choice(("source", f"'text(float64({number}), 1)'"))
        if kind == "Float32":
            return self._noise.choice(
                (f"{number}", f"1 / {number}", f"{number} * 2", f"{number} if {number} > 1 else 7")
            )
        return self._noise.choice((f"round({number} * 1000)", f"floor(1 / {number})", f"round({number})"))

    def _from_ros(self, case: str) -> str:
        kind, fields, _, more = _FROM_ROS[case]
        outlets = (*_BOARDS, "recorder") if case != "detected_object" else _OTHERS
        destinations = self._destinations(case, outlets, least=True)
        topic = self._noise.choice((f"{case}_topic", f"{case}_topic", f"shared_{kind.rpartition('/')[2]}"))
        parts = [f"source: {{topic: {topic}, type: {kind}}}", f"{more}fields: {fields}"]
        parts += [f"destinations: [{', '.join(destinations)}]", *self._age(case, destinations), *self._kind()]
        return f"  {case}: {{{', '.join(parts)}}}\n"

    def _collected(self) -> str:
        """Frames of detected objects; the route has another name in tables where one from ROS has its case."""
        destinations = self._destinations("drive_diag", ("recorder", "left_tool"), least=False)
        parts = (
            ["source: basestation", f"destinations: [{', '.join(destinations)}]"]
            if destinations
            else ["source: basestation"]
        )
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
