"""The publishers and subscriptions of a table, and their replacement at a reload."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from threading import Lock, get_ident
from time import sleep
from typing import TypeVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from router.clock import monotonic_ns
from router.compiler.compiled_table import TopicPlan
from router.declared import Demand, Wanted
from router.errors import ConfigurationError, SourceSpan
from router.log import logger
from router.ros.events import PeerEvents
from router.ros.marks import Mark
from router.ros.node import RCL_ERRORS, start_error
from router.ros.qos import publisher_qos, qos_profile, subscription_qos
from router.ros.rcl import RCL, ErrorString, SerializedMessage, function
from router.ros.receiving import RawSubscription
from router.ros.types import checked_class

_DISCOVERY_S, _POLL_S, _OTHERS_S = 0.5, 0.005, 0.1
"""Seconds: the longest wait for peers of a new endpoint, the interval between checks, and the wait for more
publishers after the first."""

CLOSING_S = 1.0
"""Timeout in seconds for closing a publisher."""


# rclpy publishes with the interpreter lock held, and Fast DDS may block for seconds, waiting for a vanished reader or
# a shared-memory port. ctypes releases the lock.
_publish_serialized = function(
    "rcl_publish_serialized_message", ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(SerializedMessage), ctypes.c_void_p
)
_wait_for_all_acked = function("rcl_publisher_wait_for_all_acked", ctypes.c_int, ctypes.c_void_p, ctypes.c_int64)
_error_string = function("rcutils_get_error_string", ErrorString)


def _rcl_error() -> Exception:
    """Return the error of this thread's last failed call to rcl."""
    text = _error_string().text.decode(errors="replace")
    RCL.rcutils_reset_error()
    error: Exception = rclpy_implementation.RCLError(text)
    return error


class Publication:
    """A publisher. `subscribers` is how many it has, `demand` what they want; native threads read it by its address.

    `publish` takes CDR bytes, is thread-safe, and releases the interpreter lock while the middleware works. It raises
    RCLError if the middleware fails or the publisher is closed.
    """

    def __init__(self, node: Node, peers: PeerEvents, plan: TopicPlan, message: type, span: SourceSpan) -> None:
        """Open the publisher. Raises StartError if the middleware refuses it."""
        self.plan = plan
        self.demand = Demand(wanted=Wanted.EVERY_MESSAGE if plan.qos.serves_late_joiners else Wanted.NOTHING)
        self.subscribers = 0
        self._samplers = 0
        self._lock = Lock()  # of these three
        with _refusing(f"{span}: topic '{plan.label}' cannot be published"), ExitStack() as opening:
            self._publisher = node.create_publisher(
                message,
                plan.topic,
                qos_profile(plan.qos),
                event_callbacks=peers.of_publisher(plan, self._matched),
                callback_group=ReentrantCallbackGroup(),  # the node's own group would leak memory
            )
            opening.callback(node.destroy_publisher, self._publisher)
            handle = self._publisher.handle
            opening.enter_context(handle)
            self._open = opening.pop_all()
        self._calls: dict[int, int] = {}  # by thread in `publish`: its start, in ns of the monotonic clock
        self._is_closed = False
        self.address: int = handle.pointer
        """The address of its `rcl_publisher_t`, valid until it is closed."""
        self.publish = self._publish_to(self.address)
        self.topic: str = handle.get_topic_name()
        self.qos = publisher_qos(handle.pointer)
        self.events: Sequence[EventHandler] = self._publisher.event_handlers

    def _matched(self, subscribers: int) -> None:
        with self._lock:
            self._note(subscribers)

    def note_samplers(self, change: int) -> None:
        """Count subscriptions of this process that want only the newest message, when `demand.is_due`."""
        with self._lock:
            self._samplers += change
            if not self._is_closed:
                self._note(self._publisher.get_subscription_count())

    def _note(self, subscribers: int) -> None:
        self.subscribers = subscribers
        if self.plan.qos.serves_late_joiners or subscribers > self._samplers:
            self.demand.wanted = Wanted.EVERY_MESSAGE
        else:
            self.demand.wanted = Wanted.NEWEST_MESSAGE if subscribers else Wanted.NOTHING

    def await_subscribers(self) -> None:
        """Wait up to 0.5 s until subscribers of an earlier publisher of the topic have discovered this one."""
        for _ in range(int(_DISCOVERY_S / _POLL_S)):
            if subscribers := self._publisher.get_subscription_count():
                self._matched(subscribers)
                return
            sleep(_POLL_S)

    def await_receipt(self, timeout: float) -> bool:
        """Wait until all reliable subscriptions have received what was published, at least in their queues.

        Return False after `timeout` s. Fast DDS passes a message to a subscription of this process within the call that
        publishes it, so best-effort subscriptions of the router also have it.
        """
        if has_failed := _wait_for_all_acked(self.address, round(timeout * 1e9)):
            RCL.rcutils_reset_error()
        return not has_failed

    def stalled(self) -> float:
        """Return how long (s) a call of `publish` has been in the middleware; 0 if no call is running."""
        since = list(self._calls.values())
        return (monotonic_ns() - min(since)) / 1e9 if since else 0.0

    def _publish_to(self, publisher: int) -> Callable[[bytes], None]:
        calls = self._calls

        def publish(cdr: bytes) -> None:
            thread = get_ident()
            calls[thread] = monotonic_ns()
            try:
                if self._is_closed:
                    raise rclpy_implementation.RCLError("the publisher was closed by a reload")
                size = len(cdr)
                if _publish_serialized(publisher, SerializedMessage(cdr, size, size), None):
                    raise _rcl_error()
            finally:
                del calls[thread]

        return publish

    def close(self) -> bool:
        """Close the publisher. If a call of `publish` is stuck in the middleware, leave it open and return False.

        Waits up to CLOSING_S for running calls. No thread may be waiting for its events.
        """
        with self._lock:
            self._is_closed = True
        for _ in range(int(CLOSING_S / _POLL_S)):
            if not self._calls:
                break
            sleep(_POLL_S)
        else:
            logger.error("a publish call is stuck in the middleware; the publisher stays open", topic=self.plan.label)
            return False
        self._open.close()
        return True


class Subscription:
    """A subscription, marked for other routers. Messages are taken through `raw`."""

    def __init__(self, node: Node, peers: PeerEvents, plan: TopicPlan, message: type, span: SourceSpan) -> None:
        """Open the subscription. Raises StartError if the middleware refuses it."""
        self.plan = plan
        with _refusing(f"{span}: topic '{plan.label}' cannot be subscribed to"):
            self.raw = RawSubscription(node, message, plan.topic, qos_profile(plan.qos), peers.of_subscription(plan))
        self.events: Sequence[EventHandler] = self.raw.events
        self.topic: str = self.raw.handle.get_topic_name()
        self.qos = subscription_qos(self.raw.handle.pointer)
        self._mark = Mark(node, self.topic)

    def await_publishers(self) -> None:
        """Wait up to 0.5 s until publishers have discovered this subscription, while an earlier one receives.

        The others usually follow soon after the first message arrives; silent publishers get the full time.
        """
        for _ in range(int(_DISCOVERY_S / _POLL_S)):
            sleep(_POLL_S)
            if self.raw.take():
                sleep(_OTHERS_S)
                return

    def close(self) -> None:
        """Close the subscription, when no thread takes from it or waits for its events."""
        self._mark.close()
        self.raw.close()


@contextmanager
def _refusing(problem: str) -> Iterator[None]:
    try:
        yield
    except RCL_ERRORS as error:
        raise start_error(error, f"{problem}: {error}") from error


Opened = TypeVar("Opened", Publication, Subscription)


@dataclass(slots=True)
class RosChange:
    """All endpoints of the next table by topic, the newly opened ones, and the unused old ones."""

    publications: dict[str, Publication]
    subscriptions: dict[str, Subscription]
    opened: Sequence[Publication | Subscription]
    unused: Sequence[Publication | Subscription] = ()


def open_missing(
    now: Mapping[str, Opened],
    plans: Sequence[TopicPlan],
    spans: Mapping[str, SourceSpan],
    open_one: Callable[[TopicPlan, type, SourceSpan], Opened],
) -> tuple[dict[str, Opened], list[Opened]]:
    """Open the endpoints of `plans` that are not in `now`. Raises StartError.

    Returns all endpoints by topic, and the newly opened ones.
    """
    classes: dict[str, type] = {}  # by name: finding a class, with the nested ones, takes half a millisecond
    for plan in plans:
        if plan.label in now and now[plan.label].plan.type_name != plan.type_name:
            kept = now[plan.label].plan.type_name  # DDS allows one type per topic in a process
            what = f"topic '{plan.label}' has the type {kept}, which cannot change to {plan.type_name}"
            raise ConfigurationError(
                f"{spans[plan.label]}: {what} while the router runs", "restart it, or use another name"
            )
        if plan.type_name not in classes:
            classes[plan.type_name] = checked_class(plan.type_name, plan.definitions, spans[plan.label])
    opened: list[Opened] = []
    with ExitStack() as opening:
        for plan in plans:
            if plan.label not in now or now[plan.label].plan != plan:
                opened.append(open_one(plan, classes[plan.type_name], spans[plan.label]))
                opening.callback(opened[-1].close)
        opening.pop_all()
    beside = {endpoint.plan.label: endpoint for endpoint in opened}
    return {plan.label: beside.get(plan.label) or now[plan.label] for plan in plans}, opened


def unused(kept: Mapping[str, Opened], now: Mapping[str, Opened]) -> list[Opened]:
    """Return the open endpoints that are not in `kept`."""
    return [endpoint for topic, endpoint in now.items() if kept.get(topic) is not endpoint]
