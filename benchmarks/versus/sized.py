"""Route tables of any size, with the .proto files and datagrams that go with them. Knows nothing of measuring.

Four payload cases are the rover's, under their own numbers; the others are copies of those four messages under names
and numbers of their own. Each case has a route with one destination.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from benchmarks.versus.building import PROGRAMS
from benchmarks.versus.contenders import PAYLOADS, datagrams
from benchmarks.versus.helpers import ALL_TOPICS
from router.types.wire import LEN
from tests.envelopes import tag
from tests.tables import PROTOS

FIRST_COPY = 101
"""Field number, above all of the rover's."""

ENVELOPE = Path("components", "common", "envelope.proto")


class Size(NamedTuple):
    """How many routes a table has, with so many topics each, and whether it has `http`."""

    routes: int
    topics: int = 2
    http: bool = True

    @property
    def folder(self) -> Path:
        """Where `write` puts the table by default."""
        return PROGRAMS / f"routes_{self.routes}_{self.topics}{'' if self.http else '_alone'}"


SMALL, LARGE, LARGEST = Size(26), Size(260), Size(1000, topics=1)
MANY, MOST, ALL_PUBLISHED = Size(1000, topics=0), Size(2500, topics=0), Size(900, topics=1, http=False)
"""Sizes for idling."""
SIZES = (SMALL, LARGE, LARGEST, MANY, MOST, ALL_PUBLISHED)


class Case(NamedTuple):
    """A payload case, its number and message, and the rover's case and message that they are like."""

    name: str
    number: int
    message: str
    like: str
    like_message: str


REAL = tuple(
    Case(name, number, message, name, message)
    for name, number, message in (
        ("imu_info", 13, "SensorBoardIMUInfo"),
        ("gps_info", 12, "SensorBoardGPSInfo"),
        ("ph_info", 1, "SensorBoardPHInfo"),
        ("sensor_diag", 11, "SensorBoardDiagnostics"),
    )
)


def write(size: Size, target: Path) -> None:
    """Makes table.yaml, payloads.txt with a datagram of each case, and protos/ in a folder."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(PROTOS, target / "protos", ignore=shutil.ignore_patterns("*.lock.json"))
    all_cases = list(_cases(size.routes))
    (target / "protos" / ENVELOPE).write_text(_envelope(all_cases), encoding="utf-8")
    (target / "payloads.txt").write_text("\n".join(_payloads(all_cases)), encoding="utf-8")
    table = yaml.safe_dump(_table(all_cases, size), sort_keys=False)
    (target / "table.yaml").write_text(table, encoding="utf-8")


def _cases(count: int) -> Iterator[Case]:
    yield from REAL
    for number in range(FIRST_COPY, FIRST_COPY + count - len(REAL)):
        like = REAL[number % len(REAL)]
        yield Case(f"{like.name}_{number}", number, f"{like.message}{number}", like.name, like.message)


def _envelope(cases: Sequence[Case]) -> str:
    """The rover's envelope with other cases, and the messages that are copies."""
    original = (PROTOS / ENVELOPE).read_text(encoding="utf-8")
    texts = (path.read_text(encoding="utf-8") for path in (PROTOS).rglob("*.proto"))
    messages = dict(re.findall(r"^message (\w+) (\{\n.*?^\})", "".join(texts), re.DOTALL | re.MULTILINE))
    lines = [original.partition("message PBEnvelope")[0], 'import "components/sensor_board/sensor.proto";']
    lines += [f"message {case.message} {messages[case.like_message]}" for case in cases if case not in REAL]
    lines += ["message PBEnvelope {", "  oneof payload {"]
    lines += [f"    {case.message} {case.name} = {case.number};" for case in cases]
    return "\n".join([*lines, "  }", "}", ""])


def _payloads(cases: Sequence[Case]) -> Iterator[str]:
    """What the rover at rest sends, each as a datagram of the case that is like it."""
    realistic = dict(reversed(datagrams(PAYLOADS)))  # of each case the first
    for case in cases:
        behind_tag = realistic[case.like][1:]  # the rover's tags have one byte
        yield f"{case.name} {(tag(case.number, LEN) + behind_tag).hex()}"


def _table(cases: Sequence[Case], size: Size) -> dict[str, Any]:
    return {
        "version": 1,
        "envelope": {"protos": "protos", "message": "PBEnvelope", "oneof": "payload"},
        **({"http": {"address": "127.0.0.1:${METRICS_PORT:-29108}"}} if size.http else {}),
        "listen": {"all": {"address": "127.0.0.1:${LISTEN_PORT:-5000}"}},
        "endpoints": {
            "sensor_board": {"address": "127.0.0.30:8", "kind": "board"},
            "first": {"address": "127.0.0.1:${FIRST_PORT:-6000}", "kind": "tool"},
        },
        "routes": {case.name: _route(case, size.topics) for case in cases},
    }


def _route(case: Case, topics: int) -> dict[str, Any]:
    route: dict[str, Any] = {"source": "sensor_board", "destinations": ["first"]}
    return route | {"topics": list(_topics(case))[:topics]} if topics else route


def _topics(case: Case) -> Iterator[dict[str, Any]]:
    topic = next(topic for topic in ALL_TOPICS if topic.case == case.like)
    fields: Any = {"auto": True, "gps_sensor": "gps_sensor_1"} if case.like == "sensor_diag" else "auto"
    name = topic.name if case in REAL else case.name
    for full_name in (name, f"{name}/again"):
        yield {"topic": full_name, "type": topic.kind, "queue_depth": 10, "fields": fields}
