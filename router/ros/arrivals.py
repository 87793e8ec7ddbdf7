"""Subscriptions that hand out CDR bytes, and the waiting for what arrives on them.

What the bytes mean, and which thread waits, is not known here.
"""

from __future__ import annotations

import ctypes
import os
import select
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile

from router.clock import wall_ns
from router.ros.node import RCL

MOST_KEPT = 5000
"""What a subscription without a depth holds: Fast DDS keeps no more samples unless it is told to."""

_set_callback = RCL.rcl_subscription_set_on_new_message_callback
_set_callback.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)

# To the middleware it is `void callback(const void *user_data, size_t messages)`, to libc `int eventfd_write(int fd,
# uint64_t value)`: where calls pass arguments in registers, a descriptor for user data makes one of the other.
_ADD_TO_EVENTFD = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)


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
        subscription = node.create_subscription(
            message_class,
            topic,
            lambda _: None,  # an executor's to call, and there is none
            qos,
            callback_group=ReentrantCallbackGroup(),  # the node's own keeps a little of each subscription for ever
            event_callbacks=event_callbacks,
            raw=True,
        )
        self.events: list[EventHandler] = subscription.event_handlers
        self.capacity: int = qos.depth if qos.history == HistoryPolicy.KEEP_LAST else MOST_KEPT
        self._node = node
        self._subscription = subscription
        self.handle = subscription.handle
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

    def take_all(self) -> list[tuple[bytes, int]]:
        """What has arrived, and no more than it holds, however fast they come."""
        return [message for _ in range(self.capacity) if (message := self.take())]

    def announce_to(self, eventfd: int | None) -> None:
        """Has the middleware add the number of new messages to `eventfd`, or to nothing from now on.

        A thread of the middleware does that, which holds the reader's lock. No Python may run there: it would wait for
        the interpreter while whoever has the interpreter waits for that lock, to take a message. When this returns,
        the eventfd that was announced to before is not touched any more. Raises one of `ros_node.RCL_ERRORS`.
        """
        callback = None if eventfd is None else _ADD_TO_EVENTFD
        if _set_callback(self.handle.pointer, callback, eventfd):
            raise rclpy_implementation.RCLError("the middleware does not tell of new messages")

    def close(self) -> None:
        """It is not announced to anybody, and nobody may take from it any more."""
        self._node.destroy_subscription(self._subscription)


class Arrivals:
    """Waits until something arrived on one of these. For one thread; `wake` is for the others.

    Each has an eventfd that is watched for writes (edge-triggered) and never read: a turn is one system call, however
    many subscriptions there are. A wait set is told of every one of them in every turn, and detaches them after it.
    """

    def __init__(self, subscriptions: Sequence[RawSubscription]) -> None:
        """Raises one of `ros_node.RCL_ERRORS`."""
        self._subscriptions: dict[int, RawSubscription] = {}
        self._eventfds: dict[RawSubscription, int] = {}
        with ExitStack() as opening:
            self._epoll = opening.enter_context(select.epoll())
            self._wake = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, self._wake)
            self._epoll.register(self._wake, select.EPOLLIN | select.EPOLLET)
            opening.callback(self._remove_all)
            for subscription in subscriptions:
                self.add(subscription)
            self._open = opening.pop_all()

    def add(self, subscription: RawSubscription) -> None:
        """Waits for this one too. Nobody may wait meanwhile. Raises one of `ros_node.RCL_ERRORS`, or OSError."""
        with ExitStack() as opening:
            eventfd = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, eventfd)
            self._epoll.register(eventfd, select.EPOLLIN | select.EPOLLET)
            subscription.announce_to(eventfd)
            opening.pop_all()
        self._subscriptions[eventfd], self._eventfds[subscription] = subscription, eventfd
        self.again(subscription)  # what came before somebody was told of it

    def remove(self, subscription: RawSubscription) -> None:
        """Does not wait for this one any more. Nobody may wait meanwhile."""
        eventfd = self._eventfds.pop(subscription)
        del self._subscriptions[eventfd]
        subscription.announce_to(None)
        self._epoll.unregister(eventfd)  # closing it does that too, unless a child process is just being made
        os.close(eventfd)

    def _remove_all(self) -> None:
        for subscription in list(self._eventfds):
            self.remove(subscription)

    def wait(self, timeout: float | None = None) -> list[RawSubscription]:
        """Those on which something may have arrived since they were last named. Waits for that, at most `timeout` s."""
        ready = self._epoll.poll(timeout, len(self._subscriptions) + 1)
        return [self._subscriptions[eventfd] for eventfd, _ in ready if eventfd != self._wake]

    def again(self, subscription: RawSubscription) -> None:
        """Has `wait` name it once more: not everything was taken."""
        os.eventfd_write(self._eventfds[subscription], 1)

    def wake(self) -> None:
        """Ends the present wait, or the next one."""
        os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        """Nobody may wait any more."""
        self._open.close()
