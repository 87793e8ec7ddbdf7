"""Small tables with the rover's messages, their counters, and envelopes for them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable, RoutePlan
from router.compiler.lookup import Definitions
from router.compiler.metrics import HISTOGRAM_CELLS
from tests.envelopes import rover_envelope
from tests.tables import PROTOS

MS = 1_000_000
SECOND = 1000 * MS

HEAD = """version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen:
  trimmed: {address: 127.0.0.1:5000, framing: zero_trimmed}
  exact: {address: 127.0.0.1:5001, framing: exact}
endpoints:
  sensor_board: {address: 192.168.0.30:8, kind: board}
  driving_board: {address: 192.168.0.222:8, kind: board}
  basestation: {address: 192.168.0.10:9000, kind: basestation}
  recorder: {address: 192.168.0.20:9000, kind: tool, trim_trailing_zeros: true}
  left_tool: {address: 192.168.0.60:7001, kind: tool, source_port: 8001}
  right_tool: {address: 192.168.0.60:7002, kind: tool, source_port: 8002}
routes:
"""
"""The beginning of each table. Its routes follow, indented by two."""

HEAD_OF_LISTENERS = (
    HEAD.replace("kind: basestation}", "kind: basestation, listener: exact}")
    .replace("source_port: 8001}", "source_port: 8001, listener: trimmed}")
    .replace("source_port: 8002}", "source_port: 8002, listener: exact}")
    .replace("  recorder:", "  impostor: {address: 192.168.0.10:9001, kind: tool, listener: trimmed}\n  recorder:")
)
"""Each endpoint is accepted by one listener only; `impostor` has the basestation's address on the other one."""

SENSOR_BOARD = ("192.168.0.30", 8)
DRIVING_BOARD = ("192.168.0.222", 8)
BASESTATION = ("192.168.0.10", 9000)
LEFT_TOOL = ("192.168.0.60", 8001)
RIGHT_TOOL = ("192.168.0.60", 8002)
STRANGER = ("192.168.0.99", 1234)


def enveloped(**payload: object) -> bytes:
    message: bytes = rover_envelope().message_class(**payload).SerializeToString()
    return message


BRAKE = enveloped(manual_brake={"brake": True})


@cache
def _definitions() -> Definitions:
    return Definitions()


def program(folder: Path, routes: str, head: str = HEAD, protos: Path | None = None) -> CompiledTable:
    """The compiled table. Findings fail the test, except payload cases without a route."""
    path = folder / "table.yaml"
    path.write_text(head.replace("PROTOS", str(protos or PROTOS)) + routes)
    checked = check_table(path, {}, _definitions())
    assert checked.program is not None, "\n".join(map(str, checked.diagnostics))
    return checked.program


class Ledger:
    """The counters of a program at the time of each call, without timestamps and histograms."""

    def __init__(self, program: CompiledTable, counts: Sequence[int]) -> None:
        self._program = program
        self._counts = counts

    def counted(self, *prefixes: str) -> Mapping[tuple[str, ...], int]:
        """The nonzero counts, by metric and labels, of metrics whose names begin with one of the prefixes."""
        return {
            (series.metric, *series.labels): self._counts[index]
            for series, index in self._program.counters.series()
            if self._counts[index] and series.metric.startswith(prefixes) and not series.metric.endswith("seconds")
        }

    def total(self, metric: str, *labels: str) -> int:
        """The sum over all series of a metric whose labels begin with these."""
        return sum(count for key, count in self.counted(metric).items() if key[: 1 + len(labels)] == (metric, *labels))

    def imbalances(self) -> Iterator[str]:
        """Errors in the balance of the counters. Valid only while no frame is open and no message is held back."""
        inbound = [plan for plans in self._program.inbound.values() for plan in plans]
        outbound = [plan for plans in self._program.outbound.values() for plan in plans]
        received, rejected = self.total("datagrams_received"), self.total("datagrams_rejected")
        accepted = sum(self.total("messages_received", plan.route) for plan in inbound)
        if received != accepted + rejected:
            yield f"received {received}, but accepted {accepted} and rejected {rejected}"
        for plan in inbound:
            yield from self._time_of_route(plan.route)
        for plan in (*inbound, *outbound):
            yield from self._fates(plan)

    def _time_of_route(self, route: str) -> Iterator[str]:
        accepted = self.total("messages_received", route)
        first = self._program.counters.index("route_duration_seconds", route)
        if accepted != (timed := sum(self._counts[first : first + HISTOGRAM_CELLS - 1])):
            yield f"{route}: accepted {accepted}, but the histogram holds {timed}"

    def _fates(self, plan: RoutePlan) -> Iterator[str]:
        route = plan.route
        for target in plan.targets:
            accepted = self.total("messages_received", route, *([target.label] if target.reply else []))
            delivered = "messages_published" if target.is_topic else "datagrams_sent"
            metrics = (delivered, "messages_dropped", "messages_filtered", "messages_collected", "messages_waiting")
            fates = [self.total(metric, route, target.label) for metric in metrics]
            split = self.total("messages_split", route, target.label)
            if accepted + split != sum(fates):
                kinds = "delivered, dropped, filtered, collected, waiting"
                yield f"{route} to {target.label}: accepted {accepted}, split {split}, but {kinds} {fates}"
