"""Receiving from ROS: subscriptions that return CDR bytes, waiting for messages, and the thread that does both."""

from __future__ import annotations

import ctypes
import os
import select
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile

from router.clock import boottime_ns, wall_ns
from router.engine.freshness import Freshness
from router.ros.rcl import RCL, address
from router.threads import Thread, join_or_leave, paused

Receive = Callable[[bytes, int, bool], None]
"""Called with CDR bytes, the time at which the message set out, in ns of the wall clock, and whether it is known to
come after the topic's last one, as that is of the same publisher."""

_MOST_LOST = 100
"""A number that is higher by more is rather another publisher's."""

MOST_KEPT = 5000
"""Messages that a subscription without a depth holds: the default of Fast DDS."""

TURN = 32
"""Messages of one topic that are served before others have their turn."""

_set_callback = RCL.rcl_subscription_set_on_new_message_callback
_set_callback.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)

# The middleware calls `void callback(const void *user_data, size_t messages)`; where arguments are passed in registers,
# libc's `int eventfd_write(int fd, uint64_t value)` can be that callback, with the descriptor as user data.
_ADD_TO_EVENTFD = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)

TAKE, RESET = map(address, ("rcl_take_serialized_message", "rcutils_reset_error"))
"""Addresses of what a native thread calls to take messages, and to forget why it could not."""

_LOOK_S = 0.25
"""The longest time between two looks at the clocks, in seconds."""


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
        """Raises one of `RCL_ERRORS`."""
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
        self._number = 0
        self.follows = False
        """Whether the message that was last taken comes after the one before, as both are of the same publisher."""
        self.handle = subscription.handle
        self._message_class = message_class

    @property
    def address(self) -> int:
        """That of its `rcl_subscription_t`, until it is closed."""
        return int(self.handle.pointer)

    def take(self) -> tuple[bytes, int] | None:
        """Return the oldest message and when it set out, in ns of the wall clock; None if there is no message.

        That is when it was sent by the sender's clock, or received by ours if that is earlier. The time of receipt
        alone would make old messages look new: reliable DDS repairs a loss seconds later and keeps messages for late
        joiners, and a process that was stopped receives all that was sent meanwhile at once.
        """
        taken = self.handle.take_message(self._message_class, True)
        if taken is None:
            return None
        cdr, info = taken
        before, self._number = self._number, info["publication_sequence_number"]  # each publisher counts its messages
        self.follows = 0 < self._number - before <= _MOST_LOST
        sent, received = info["source_timestamp"], info["received_timestamp"]  # 0 if unknown to the middleware
        return cdr, min(sent or received, received or sent) or wall_ns()

    def take_all(self) -> list[tuple[bytes, int]]:
        """Return what has arrived, at most `capacity` messages, however fast they come."""
        return [message for _ in range(self.capacity) if (message := self.take())]

    def announce_to(self, eventfd: int | None) -> None:
        """Have the middleware add the number of new messages to `eventfd`, or to none.

        A thread of the middleware does that while it holds the reader's lock. No Python code may run there: it would
        wait for the interpreter while the thread that has the interpreter waits for that lock, to take a message. When
        this returns, the previous eventfd is no longer used. Raises one of `RCL_ERRORS`.
        """
        callback = None if eventfd is None else _ADD_TO_EVENTFD
        # rmw_fastrtps counts what is there, then begins to listen: only a second call counts what comes in between.
        for _ in range(1 if eventfd is None else 2):
            if _set_callback(self.handle.pointer, callback, eventfd):
                raise rclpy_implementation.RCLError("the middleware does not tell of new messages")

    def close(self) -> None:
        """To be called when nothing is announced, and no thread takes from it."""
        self._node.destroy_subscription(self._subscription)


class Arrivals:
    """Waits until messages have arrived on subscriptions. For one thread; others may call `wake`.

    Each subscription has an eventfd that is watched for writes (edge-triggered) and never read: a wait is one system
    call, however many subscriptions there are. A wait set of rcl attaches and detaches each of them for every wait.
    """

    def __init__(self, subscriptions: Sequence[RawSubscription]) -> None:
        """Raises one of `RCL_ERRORS`."""
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
        """Wait for this subscription too. Not to be called during a wait. Raises one of `RCL_ERRORS`, or OSError."""
        with ExitStack() as opening:
            eventfd = os.eventfd(0, os.EFD_CLOEXEC)
            opening.callback(os.close, eventfd)
            self._epoll.register(eventfd, select.EPOLLIN | select.EPOLLET)
            subscription.announce_to(eventfd)
            opening.pop_all()
        self._subscriptions[eventfd], self._eventfds[subscription] = subscription, eventfd
        self.again(subscription)  # for messages that came before it was announced

    def remove(self, subscription: RawSubscription) -> None:
        """No longer wait for this subscription. Not to be called during a wait."""
        eventfd = self._eventfds.pop(subscription)
        del self._subscriptions[eventfd]
        subscription.announce_to(None)
        self._epoll.unregister(eventfd)  # closing alone is not enough while a child process is being made
        os.close(eventfd)

    def _remove_all(self) -> None:
        for subscription in list(self._eventfds):
            self.remove(subscription)

    def wait(self, timeout: float | None = None) -> list[RawSubscription]:
        """Return subscriptions with possible new messages since the last call. Waits for them, at most `timeout` s."""
        ready = self._epoll.poll(timeout, len(self._subscriptions) + 1)
        return [self._subscriptions[eventfd] for eventfd, _ in ready if eventfd != self._wake]

    def again(self, subscription: RawSubscription) -> None:
        """Have `wait` return this subscription once more, as not everything was taken."""
        os.eventfd_write(self._eventfds[subscription], 1)

    def wake(self) -> None:
        """End the present wait, or the next one."""
        os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        self._open.close()


class MessageThread:
    """Passes the messages of subscriptions to the functions set by `serve`. It starts once and stops once.

    `failed` is called with what they raise. `freshness` is that of the messages. Stopping serves what has arrived by
    then.
    """

    def __init__(self, failed: Callable[[Exception], None], freshness: Freshness) -> None:
        """Raises one of `RCL_ERRORS`."""
        self._freshness = freshness
        self._receive: dict[RawSubscription, Receive] = {}
        self._failed = failed
        self._arrivals = Arrivals([])
        self._tasks: deque[Callable[[], None]] = deque()
        self._stopping = False
        self._thread = Thread(self._run, "ros")

    @classmethod
    def serving(
        cls, receive: Mapping[RawSubscription, Receive], failed: Callable[[Exception], None], freshness: Freshness
    ) -> MessageThread:
        """Return a started thread that serves these. Raises one of `RCL_ERRORS`."""
        thread = cls(failed, freshness)
        with ExitStack() as opening:
            opening.callback(thread._arrivals.close)
            thread.serve(receive)  # announces at once what has arrived by now
            thread._thread.start()
            opening.pop_all()
        return thread

    def stop(self) -> bool:
        """Return False if the thread is stuck in the middleware, and left: then subscriptions must stay open."""
        self._stopping = True
        self._arrivals.wake()
        has_ended = join_or_leave(self._thread)
        if has_ended:
            self._arrivals.close()
        return has_ended

    def paused(self) -> AbstractContextManager[None]:
        """The thread takes no message inside. Raises StuckError."""
        return paused(self._submit)

    def serve(self, receive: Mapping[RawSubscription, Receive]) -> None:
        """Replace the subscriptions and their functions. To be called before the start, or while paused.

        Raises one of `RCL_ERRORS`, or OSError, with nothing changed.
        """
        with ExitStack() as adding:
            for subscription in receive.keys() - self._receive.keys():
                self._arrivals.add(subscription)
                adding.callback(self._arrivals.remove, subscription)
            adding.pop_all()
        for subscription in self._receive.keys() - receive.keys():
            self._arrivals.remove(subscription)
        self._receive = dict(receive)

    def serves(self, subscription: RawSubscription) -> bool:
        return subscription in self._receive

    def finish(self, subscription: RawSubscription) -> list[tuple[bytes, int]]:
        """Serve what has arrived on a subscription that is going to be removed, and return it. While paused."""
        messages = subscription.take_all()
        for message in messages:
            self._pass_on(self._receive[subscription], message)
        return messages

    def _submit(self, task: Callable[[], None]) -> None:
        self._tasks.append(task)
        self._arrivals.wake()

    def _run(self) -> None:
        while not self._stopping:
            arrived = self._arrivals.wait(_LOOK_S)
            now = boottime_ns()
            self._freshness.look(wall_ns(), now)
            for subscription in arrived:
                self._do_tasks()
                if subscription in self._receive:
                    self._serve(subscription)
            self._do_tasks()
        for subscription in self._receive:
            self.finish(subscription)

    def _do_tasks(self) -> None:
        while self._tasks:
            self._tasks.popleft()()

    def _serve(self, subscription: RawSubscription) -> None:
        receive = self._receive[subscription]
        for _ in range(TURN):
            try:
                if (message := subscription.take()) is None:
                    return
                receive(*message, subscription.follows)
            except Exception as error:  # noqa: BLE001 a bug of the router is reported, and receiving goes on
                self._failed(error)
        self._arrivals.again(subscription)

    def _pass_on(self, receive: Receive, message: tuple[bytes, int]) -> None:
        try:
            receive(*message, False)
        except Exception as error:  # noqa: BLE001 as above
            self._failed(error)
