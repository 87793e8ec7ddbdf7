"""An engine between fakes: outlets that record and fail when told to, and clocks that stand still until told to go."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

from router.assets import asset
from router.compiler import check_table
from router.compiler.definitions import Definitions
from router.compiler.program import Program
from router.engine import Engine, Report
from router.engine.binding import Outlets
from tests.engine.ledger import Ledger

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
"""Every table of these tests begins like this; what follows are its routes, indented by two."""

SENSOR_BOARD = ("192.168.0.30", 8)
DRIVING_BOARD = ("192.168.0.222", 8)
BASESTATION = ("192.168.0.10", 9000)
LEFT_TOOL = ("192.168.0.60", 8001)
RIGHT_TOOL = ("192.168.0.60", 8002)
STRANGER = ("192.168.0.99", 1234)

Outlet = Callable[[bytes], None]


@cache
def _definitions() -> Definitions:
    return Definitions()


def program(folder: Path, routes: str, head: str = HEAD, protos: Path | None = None) -> Program:
    """The compiled table. What is wrong with it fails the test; a case that is not covered is fine."""
    path = folder / "table.yaml"
    path.write_text(head.replace("PROTOS", str(protos or asset("protos"))) + routes)
    checked = check_table(path, {}, _definitions())
    assert checked.program is not None, "\n".join(map(str, checked.diagnostics))
    return checked.program


class Rig:
    """An engine and everything that came out of it.

    `failures` makes an outlet raise, by endpoint or topic. `now` is the monotonic clock in ns, the wall
    clock is `WALL` ahead of it; every call of an outlet takes `work_ns`. `unwanted` topics have no subscriber.
    """

    WALL = 1_700_000_000_000_000_000

    def __init__(self, made: Program, unwanted: frozenset[str] = frozenset()) -> None:
        self.program = made
        self.counts = made.books.fresh_counts()
        self.ledger = Ledger(made, self.counts)
        self.now = 0
        self.work_ns = 0
        self.sent: list[tuple[str, bytes]] = []
        self.published: list[tuple[str, bytes]] = []
        self.reports: list[Report] = []
        self.failures: dict[str, Exception] = {}
        self.wanted = {plan.topic: [plan.topic not in unwanted] for plan in made.publishers}
        self.outlets = Outlets(
            self.counts,
            {plan.endpoint: self._sender(plan.endpoint) for plan in made.senders},
            {plan.topic: self._outlet(plan.topic, self.published) for plan in made.publishers},
            self.wanted,
            self.reports.append,
            (PublishError,),
        )
        engine = Engine(
            made,
            self.counts,
            self.outlets.send,
            self.outlets.publish,
            self.wanted,
            self.reports.append,
            lambda: self.now,
            lambda: self.WALL + self.now,
            self.outlets.publish_errors,
        )
        self.receivers = {plan.name: engine.receiver(plan.name) for plan in made.listeners}

    def receive(self, data: bytes, peer: tuple[str, int] = SENSOR_BOARD, listener: str = "trimmed") -> None:
        self.receivers[listener](data, peer)

    def count(self, metric: str, *labels: str, part: int = 0) -> int:
        return self.counts[self.program.books.slot(metric, *labels) + part]

    def counted(self, *prefixes: str) -> Mapping[tuple[str, ...], int]:
        return self.ledger.counted(*prefixes)

    def rejected(self, listener: str = "trimmed") -> str | None:
        """The one reason for which this listener rejected anything."""
        found = [labels[2] for labels in self.counted("datagrams_rejected") if labels[1] == listener]
        assert len(found) <= 1
        return found[0] if found else None

    def dropped(self, route: str, target: str) -> Mapping[str, int]:
        found = self.counted("messages_dropped").items()
        return {labels[3]: count for labels, count in found if labels[1:3] == (route, target)}

    def assert_books_balance(self) -> None:
        assert list(self.ledger.imbalances()) == []

    def _sender(self, endpoint: str) -> Callable[[bytes], int]:
        take = self._outlet(endpoint, self.sent)

        def send(datagram: bytes) -> int:
            take(datagram)
            return len(datagram)

        return send

    def _outlet(self, name: str, taken: list[tuple[str, bytes]]) -> Outlet:
        def take(data: bytes) -> None:
            self.now += self.work_ns
            if name in self.failures:
                raise self.failures[name]
            taken.append((name, data))

        return take


class PublishError(Exception):
    """What the middleware raises here."""
