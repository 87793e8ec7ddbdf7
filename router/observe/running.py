"""The interface of a running router to its services: recordings, HTTP, diagnostics, Foxglove."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple, Protocol

from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Mismatch
from router.errors import Diagnostic
from router.observe.obedience import Replies
from router.observe.snapshot import SERIES, Snapshot
from router.recording.mirror import Mirror

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric as Family


class ReloadResult(NamedTuple):
    """The result of a reload: the findings of the table, and one line that says what changed, or why nothing did."""

    ok: bool
    findings: tuple[Diagnostic, ...]
    text: str


class Running(Protocol):
    """Thread-safe."""

    mirror: Mirror

    @property
    def program(self) -> CompiledTable:
        """The running program; a reload replaces it."""

    @property
    def is_ready(self) -> bool:
        """Whether everything is open, and datagrams are received."""

    def collect(self) -> Iterator[Family]:
        """Return all metrics, for prometheus_client."""

    def read(self, now: int, metrics: Collection[str] = SERIES) -> Snapshot:
        """Return the values of these metrics at `now` (boot clock, ns)."""

    def mismatches(self) -> Mapping[Mismatch, int]:
        """Return messages from hosts that no route accepts them from, and their latest time (boot clock, ns)."""

    def replies(self) -> Replies:
        """Return what boards have shown about the brakes of the deadmen that send now."""

    def progress(self) -> int:
        """Return a number that changes at least every half second unless the receive thread is stuck."""

    def reload(self) -> ReloadResult:
        """Read the table again and switch to it; one call at a time. Errors of the table are returned, not raised."""
