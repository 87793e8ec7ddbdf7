"""A running router as its surroundings see it: recordings, HTTP, diagnostics. Says what they may ask and ask for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

from prometheus_client.metrics_core import Metric as Family

from router.compiler.program import Program
from router.errors import Diagnostic
from router.recording.mirror import Mirror


class ReloadResult(NamedTuple):
    """What became of a reload: the findings of the table, and in a line what changed or why nothing did."""

    ok: bool
    findings: tuple[Diagnostic, ...]
    text: str


class Running(Protocol):
    """Any thread may use it."""

    mirror: Mirror

    @property
    def program(self) -> Program:
        """What runs now; a reload puts another one in its place."""

    @property
    def is_ready(self) -> bool:
        """Everything is open, and datagrams are received."""

    def samples(self) -> Iterator[tuple[str, dict[str, str], float]]:
        """Name, labels and value of each series, as /metrics has them."""

    def collect(self) -> Iterator[Family]:
        """The same, as prometheus_client wants them."""

    def progress(self) -> int:
        """A number that changes at least every half second unless the receive thread is stuck."""

    def reload(self) -> ReloadResult:
        """Reads the table anew and swaps; one at a time. What is wrong with the table is told, not raised."""
