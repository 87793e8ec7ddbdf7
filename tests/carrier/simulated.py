"""Runs on the simulation, to compare with threads: sent, published, counted and lost messages."""

from __future__ import annotations

from router.carrier.events import CountedReport
from router.carrier.simulation import Output, Simulation
from router.compiler.compiled_table import CompiledTable
from router.library import library
from tests.small_tables import Ledger

START = 10**12


class Simulated:
    """One run of a program. `outputs` has sent and published messages, `losses` the route and target of each loss."""

    def __init__(self, program: CompiledTable) -> None:
        self.simulation = Simulation(library(), START)
        self.simulation.adopt(program)
        self._program = program
        self.outputs: list[tuple[str, bytes]] = []
        self.losses: list[tuple[str, str]] = []

    def ledger(self) -> Ledger:
        """The current counts."""
        return Ledger(self._program, self.simulation.counters(len(self._program.counters.fresh_counts())))

    def to(self, target: str) -> list[bytes]:
        """The messages sent to this endpoint or published on this topic."""
        for record in self.simulation.records():
            if isinstance(record, Output):
                self.outputs.append(record)
            elif isinstance(record, CountedReport) and record.report.kind == "drop":
                self.losses.append((record.report.place, record.report.target))
        return [data for name, data in self.outputs if name == target]
