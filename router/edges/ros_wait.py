"""Subscriptions that hand out CDR bytes, and a wait set that is made once: rclpy's executor makes one per message.

What the bytes mean, and which thread waits, is not known here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile

from router.edges.clock import wall_ns

MOST_KEPT = 5000
"""What a subscription without a depth holds: Fast DDS keeps no more samples unless it is told to."""


class RawSubscription:
    """A subscription whose messages are taken as CDR bytes, when its owner wants to. It holds up to `capacity`."""

    def __init__(
        self,
        node: Node,
        message_class: Any,
        topic: str,
        qos: QoSProfile,
        event_callbacks: SubscriptionEventCallbacks | None = None,
    ) -> None:
        """Raises one of `ros_node.RCL_ERRORS`."""
        subscription = node.create_subscription(  # the callback is an executor's to call, and there is none
            message_class, topic, lambda _: None, qos, raw=True, event_callbacks=event_callbacks
        )
        self.handle = subscription.handle
        self.events: list[EventHandler] = subscription.event_handlers
        self.capacity: int = qos.depth if qos.history == HistoryPolicy.KEEP_LAST else MOST_KEPT
        self._message_class = message_class

    def take(self) -> tuple[bytes, int] | None:
        """The oldest message that waits, and when it set out, in ns of the wall clock; None when there is none.

        That is when it was sent by the sender's clock, or came in by ours if that is earlier. When it came in alone
        would make new what is not: reliable DDS repairs a loss seconds later, keeps messages for late joiners, and
        a process that was stopped finds all that was sent meanwhile coming in at once.
        """
        taken = self.handle.take_message(self._message_class, True)
        if taken is None:
            return None
        cdr, info = taken
        sent, came_in = info["source_timestamp"], info["received_timestamp"]  # 0 from a middleware that does not tell
        return cdr, min(sent or came_in, came_in or sent) or wall_ns()


class WaitSet:
    """Waits until one of these has something. For one thread; `wake` is for the others."""

    def __init__(
        self, node: Node, subscriptions: Sequence[RawSubscription] = (), events: Sequence[EventHandler] = ()
    ) -> None:
        self._handles = [subscription.handle for subscription in subscriptions]
        self._by_pointer = {subscription.handle.pointer: subscription for subscription in subscriptions}
        self._events = events
        self._guard = GuardCondition(None, None, node.context)
        self._set = rclpy_implementation.WaitSet(len(subscriptions), 1, 0, 0, 0, len(events), node.context.handle)

    def wait(self, timeout_ns: int = -1) -> None:
        """Until something is there or `wake` is called, at most `timeout_ns` (negative: for ever).

        No Python runs in this thread meanwhile, signal handlers included.
        """
        waiting = self._set
        waiting.clear_entities()  # waiting takes out what is not ready
        waiting.add_guard_condition(self._guard.handle)
        for handle in self._handles:
            waiting.add_subscription(handle)
        for event in self._events:
            event.add_to_wait_set(waiting)
        waiting.wait(timeout_ns)

    def ready_subscriptions(self) -> list[RawSubscription]:
        """Those that had a message when `wait` returned."""
        return [self._by_pointer[pointer] for pointer in self._set.get_ready_entities("subscription")]

    def happened(self) -> Iterator[tuple[EventHandler, Any]]:
        """The events that had happened when `wait` returned, each with its status."""
        for event in self._events:
            if event.is_ready(self._set):
                yield event, event.take_data()

    def wake(self) -> None:
        """Ends the present wait, or the next one."""
        self._guard.trigger()

    def close(self) -> None:
        """Nobody may wait any more."""
        self._set.destroy_when_not_in_use()
        self._guard.destroy()
