"""The calls of services, as read from a router's counters."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import cast

from router.clock import boottime_ns
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import CALL_BOUNDS_NS, HISTOGRAM_CELLS
from router.observe.services import ServiceReading, service_readings
from router.observe.status import Status
from router.observe.watch import Health
from router.tools.top import view
from tests.observe.fake_running import FakeHealth, FakeRunning

TABLE = """\
version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 127.0.0.5:7}}
endpoints: {nav_board: {address: 127.0.0.30:8, kind: board}}
services:
  arm:
    type: std_srvs/srv/SetBool
    request: {case: arm_request, to: nav_board, fields: {armed: data}, ttl: 1s}
    reply: {case: arm_reply, fields: {success: ok}}
    timeout: 1s
    on_timeout: {success: false}
routes: {}
"""
MS = 1_000_000


def program(folder: Path) -> CompiledTable:
    path = folder / "table.yaml"
    path.write_text(TABLE.replace("PROTOS", str(Path(__file__).parents[1] / "bad_tables/protos/calls")))
    checked = check_table(path, {})
    assert checked.program is not None, checked.diagnostics
    return checked.program


def note(running: FakeRunning, outcome: str, *milliseconds: int) -> None:
    index = running.program.counters.index
    running.counts[index("service_calls", "arm", outcome)] += len(milliseconds)
    histogram = index("service_call_seconds", "arm")
    for each in milliseconds:
        bucket = sum(bound < each * MS for bound in CALL_BOUNDS_NS)
        running.counts[histogram + bucket] += 1
        running.counts[histogram + HISTOGRAM_CELLS - 1] += each * MS


def test_calls_are_told_everywhere_with_their_median_and_worst_time(tmp_path: Path) -> None:
    running = FakeRunning(program(tmp_path))
    with closing(running.mirror), closing(Status(running, cast("Health", FakeHealth(running)))) as status:
        [unused] = status.numbers()["services"]
        assert unused == {"name": "arm", "text": "no call has ended"}
        note(running, "answered", 15, 15)
        running.counts[running.program.counters.index("service_calls_open", "arm")] = 2
        [used] = status.numbers()["services"]
        assert used["text"] == "2 open, 2 answered, median 15 ms, at most 20 ms"
        note(running, "timed_out", 9000)
        [late] = json.loads(json.dumps(status.health(), allow_nan=False))["services"]
        assert ServiceReading(**late) == ServiceReading("arm", 2, {"answered": 2, "timed_out": 1}, 0.0175, None)
        reading = running.read(boottime_ns())
        assert view(reading, reading).services == tuple(service_readings(reading))
        assert [each.name for each in service_readings(reading)] == ["arm"]
