"""Which targets Python serves: those that hold messages back, and what shares its order with one.

The carrier serves all others. An endpoint gets datagrams in the order of their arrival, whatever routes they take, and
a topic its messages: so all that goes from UDP to one endpoint or topic has one executor. So has all that one topic of
ROS feeds, since one thread takes its messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.checked import CheckedRoute, CheckedSubscription, CheckedTarget
from router.errors import SourceSpan
from router.table.model import OnLimit, Route


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
    """The executors of all targets of a table without errors."""
    from_udp = [(checked, target) for checked in routes for target in checked.targets]
    published = [(checked, target) for checked, target in from_udp if target.topic]
    sent = [(checked, target) for checked, target in from_udp if not target.topic]
    return {
        **{(route, None, endpoint): executor for route, endpoint, executor in _in_one_order(sent)},
        **{(route, topic, None): executor for route, topic, executor in _in_one_order(published)},
        **dict(_of_topics(routes)),
    }


def _in_one_order(
    targets: Sequence[tuple[CheckedRoute, CheckedTarget]],
) -> Iterator[tuple[str, str, Executor]]:
    """The executors by route and label: Python's, if it serves one target of that label."""
    own = [(checked.route.name, target, _own_executor(target)) for checked, target in targets]
    needs_python: dict[str, tuple[str, SourceSpan]] = {}  # the first route that does, and its target
    for route, target, executor in own:
        if not executor.is_carrier:
            needs_python.setdefault(target.label, (route, target.span))
    for route, target, executor in own:
        is_shared = executor.is_carrier and target.label in needs_python
        yield route, target.label, _shared(target.label, *needs_python[target.label]) if is_shared else executor


def _of_topics(
    routes: Iterable[CheckedRoute],
) -> Iterator[tuple[tuple[str, str | None, str | None], Executor]]:
    """The executors of all that topics of ROS feed."""
    topics: dict[str, list[tuple[CheckedRoute, CheckedSubscription]]] = {}
    for checked in routes:
        for feed in checked.subscriptions:
            topics.setdefault(feed.topic.topic.value, []).append((checked, feed))
    for topic, feeds in topics.items():
        targets = [(checked, target) for checked, feed in feeds for target in feed.targets]
        own = (_own_executor(target) for _, target in targets)
        executor = next((each for each in own if not each.is_carrier), CARRIER)
        if not executor.is_carrier and any(is_urgent(checked.route, feed) for checked, feed in feeds):
            executor = Executor(f"{executor.reason}; its freshness is Python's", executor.span)
        for checked, target in targets:
            yield (checked.route.name, topic, target.label), executor


def is_urgent(route: Route, feed: CheckedSubscription) -> bool:
    """Whether messages from a topic are served before others: they expire, or feed or disarm a deadman."""
    return route.ttl is not None or any(target.deadmen for target in feed.targets)


def _own_executor(target: CheckedTarget) -> Executor:
    """The executor of a target, without regard to others."""
    if target.topic and target.declared.on_limit is OnLimit.LATEST:
        return Executor("`on_limit: latest` needs it", target.span)
    return CARRIER


def _shared(label: str, route: str, span: SourceSpan) -> Executor:
    return Executor(f"it shares '{label}' with {route}, which needs Python", span)
