"""Which executor serves a destination: the carrier, or Python.

The carrier forwards envelopes as they were encoded. It knows `ttl`, `max_rate`, deadmen, `trim_trailing_zeros` and what
a board can take, but evaluates no expression and holds nothing back. An endpoint gets datagrams in the order of their
arrival, whatever routes they take, so all its targets from UDP have the same executor: Python, if one of them needs it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.checked import CheckedRoute, CheckedTarget
from router.errors import SourceSpan
from router.table.model import OnLimit


@dataclass(frozen=True, slots=True)
class Executor:
    """`reason` is why a target needs Python, and `span` where the table says so; None for one that is carried."""

    reason: str | None = None
    span: SourceSpan | None = None

    @property
    def is_carrier(self) -> bool:
        return self.reason is None


Executors = Mapping[tuple[str, str | None, str | None], Executor]
"""By route, topic and endpoint: what is forwarded has no topic, and a topic that is published no endpoint."""

CARRIER = Executor()


def executors(routes: Sequence[CheckedRoute]) -> Executors:
    """The executors of all targets that send datagrams from UDP, in a table without errors."""
    needs_python: dict[str, tuple[str, SourceSpan]] = {}  # by endpoint: the first route that does, and its target
    own: dict[tuple[str, str], Executor] = {}
    for route, target in _forwarded(routes):
        own[route, target.label] = executor = _own_executor(target)
        if not executor.is_carrier:
            needs_python.setdefault(target.label, (route, target.span))
    return {
        (route, None, endpoint): _shared(endpoint, *needs_python[endpoint])
        if executor.is_carrier and endpoint in needs_python
        else executor
        for (route, endpoint), executor in own.items()
    }


def _forwarded(routes: Sequence[CheckedRoute]) -> Iterator[tuple[str, CheckedTarget]]:
    for checked in routes:
        for target in checked.targets:
            if not target.topic:
                yield checked.route.name, target


def _own_executor(target: CheckedTarget) -> Executor:
    """The executor of a target, without regard to the others of its endpoint."""
    if target.when is not None:
        return Executor(f"`when: {target.declared.when}` needs it", target.when.span)
    if target.declared.on_limit is OnLimit.LATEST:
        return Executor("`on_limit: latest` needs it", target.span)
    if target.endpoint is not None and target.endpoint.bandwidth is not None:
        return Executor(f"the bandwidth of '{target.label}' needs it", target.endpoint.span)
    return CARRIER


def _shared(endpoint: str, route: str, span: SourceSpan) -> Executor:
    return Executor(f"it shares '{endpoint}' with {route}, which needs Python", span)
