"""Receiving from ROS: subscriptions that return CDR bytes, and waiting for messages."""

from __future__ import annotations

import ctypes
import os
import select
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile

from router.clock import wall_ns
from router.ros.rcl import address, callback_setter

MOST_KEPT = 5000
"""Messages that a subscription without a depth holds: the default of Fast DDS."""

_set_callback = callback_setter("rcl_subscription_set_on_new_message_callback")

# The middleware calls `void callback(const void *user_data, size_t messages)`; where arguments are passed in registers,
# libc's `int eventfd_write(int fd, uint64_t value)` can be that callback, with the descriptor as user data.
_ADD_TO_EVENTFD = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
"""The callback that adds the number of new messages to an eventfd."""


def announce(set_callback: Callable[..., int], handle: Any, eventfd: int | None, what: str = "messages") -> None:
    """Have the middleware add the number of new messages of a handle to `eventfd`, or to none. `what` they are.

    `set_callback` is the `callback_setter` for this kind of handle. A thread of the middleware calls back while it
    holds the reader's lock. No Python code may run there: it would wait for the interpreter lock while the thread that
    holds it waits for the reader's lock, to take a message. When this returns, the previous eventfd is no longer used.
    Raises one of `RCL_ERRORS`.
    """
    callback = None if eventfd is None else _ADD_TO_EVENTFD
    # rmw_fastrtps counts waiting messages, then begins to listen: only a second call counts those in between.
    for _ in range(1 if eventfd is None else 2):
        if set_callback(handle.pointer, callback, eventfd):
            raise rclpy_implementation.RCLError(f"the middleware does not report new {what}")


def sent_at(sent: int, received: int) -> int:
    """Return when a message was sent, in ns of the wall clock; a time that the middleware does not know is 0.

    That is the sender's time stamp, or our time of receipt if that is earlier. The time of receipt alone would make old
    messages look new: reliable DDS repairs a loss seconds later and keeps messages for late joiners, and a process that
    was stopped receives everything sent meanwhile at once.
    """
    return min(sent or received, received or sent) or wall_ns()


TAKE, RESET = map(address, ("rcl_take_serialized_message", "rcutils_reset_error"))
"""Addresses of the functions with which a native thread takes messages and resets errors."""


class RawSubscription:
    """A subscription whose messages are taken as CDR bytes. It holds up to `capacity` messages."""

    def __init__(
        self,
        node: Node,
        message_class: Any,
        topic: str,
        qos: QoSProfile,
        event_callbacks: SubscriptionEventCallbacks | None = None,
    ) -> None:
        """Open the subscription. Raises one of `RCL_ERRORS`."""
        subscription = node.create_subscription(
            message_class,
            topic,
            lambda _: None,  # not called without an executor
            qos,
            callback_group=ReentrantCallbackGroup(),  # the node's own group would leak memory
            event_callbacks=event_callbacks,
            raw=True,
        )
        self.events: list[EventHandler] = subscription.event_handlers
        self.capacity: int = qos.depth if qos.history == HistoryPolicy.KEEP_LAST else MOST_KEPT
        self._node = node
        self._subscription = subscription
        self.handle = subscription.handle
        self._message_class = message_class

    @property
    def address(self) -> int:
        """The address of its `rcl_subscription_t`, valid until it is closed."""
        return int(self.handle.pointer)

    def take(self) -> tuple[bytes, int] | None:
        """Return the oldest message and its time of sending (see `sent_at`); None if there is no message."""
        taken = self.handle.take_message(self._message_class, True)
        if taken is None:
            return None
        cdr, info = taken
        return cdr, sent_at(info["source_timestamp"], info["received_timestamp"])

    def take_all(self) -> list[tuple[bytes, int]]:
        """Return the messages that have arrived, at most `capacity`, even if more keep arriving."""
        return [message for _ in range(self.capacity) if (message := self.take())]

    def announce_to(self, eventfd: int | None) -> None:
        """Have the middleware add the number of new messages to `eventfd`, or to none. Raises one of `RCL_ERRORS`."""
        announce(_set_callback, self.handle, eventfd)

    def close(self) -> None:
        """Close the subscription, when it announces to no eventfd and no thread takes from it."""
        self._node.destroy_subscription(self._subscription)


class Arrivals:
    """Waits for messages on subscriptions. For one thread.

    Each subscription has an eventfd that is watched for writes (edge-triggered) and never read: a wait is one system
    call, however many subscriptions there are. A wait set of rcl attaches and detaches each of them for every wait.
    """

    def __init__(self, subscriptions: Sequence[RawSubscription]) -> None:
        """Wait for messages on these subscriptions. Raises one of `RCL_ERRORS`."""
        self._subscriptions: dict[int, RawSubscription] = {}
        self._eventfds: dict[RawSubscription, int] = {}
        with ExitStack() as opening:
            self._epoll = opening.enter_context(select.epoll())
            opening.callback(self._remove_all)
            for subscription in subscriptions:
                self.add(subscription)
            self._open = opening.pop_all()

    def add(self, subscription: RawSubscription) -> None:
        """Also wait for this subscription. Do not call during a wait. Raises one of `RCL_ERRORS`, or OSError."""
        with ExitStack() as opening:
            eventfd = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, eventfd)
            self._epoll.register(eventfd, select.EPOLLIN | select.EPOLLET)
            subscription.announce_to(eventfd)
            opening.pop_all()
        self._subscriptions[eventfd], self._eventfds[subscription] = subscription, eventfd
        self.again(subscription)  # for messages that arrived earlier

    def remove(self, subscription: RawSubscription) -> None:
        """Stop waiting for this subscription. Do not call during a wait."""
        eventfd = self._eventfds.pop(subscription)
        del self._subscriptions[eventfd]
        subscription.announce_to(None)
        self._epoll.unregister(eventfd)  # closing alone is not enough while a child process is being made
        os.close(eventfd)

    def _remove_all(self) -> None:
        for subscription in list(self._eventfds):
            self.remove(subscription)

    def wait(self, timeout: float | None = None) -> list[RawSubscription]:
        """Wait, at most `timeout` s, and return the subscriptions that may have new messages since the last call."""
        ready = self._epoll.poll(timeout, max(1, len(self._subscriptions)))
        return [self._subscriptions[eventfd] for eventfd, _ in ready]

    def again(self, subscription: RawSubscription) -> None:
        """Have `wait` return this subscription again, because not all of its messages were taken."""
        os.eventfd_write(self._eventfds[subscription], 1)

    def close(self) -> None:
        self._open.close()
