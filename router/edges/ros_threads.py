"""The two threads that wait on ROS. Messages have one of their own because a turn costs what its wait set holds:
with the events of a rover's topics in it, a message would cost twice as much.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

from rclpy.event_handler import EventHandler
from rclpy.node import Node

from router.edges.log import logger
from router.edges.ros_wait import RawSubscription, WaitSet

Receive = Callable[[bytes, int], None]

LOOK_INTERVAL_NS = 1_000_000_000
"""How long ROS may have been shut down by somebody else before that is noticed."""

TURN = 32
"""Messages of one topic that are served before others have their turn."""


class _WaitThread(ABC):
    """Waits and serves in turn until it is stopped. It starts once and stops once."""

    def __init__(self, name: str, wait_set: WaitSet) -> None:
        self._wait_set = wait_set
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping = True
        self._wait_set.wake()
        self._thread.join()
        self._wait_set.close()

    @abstractmethod
    def _run(self) -> None: ...


class EventThread(_WaitThread):
    """Calls the callbacks of events when they happen."""

    def __init__(self, node: Node, events: Sequence[EventHandler]) -> None:
        super().__init__("ros events", WaitSet(node, events=events))
        self._context = node.context

    def _run(self) -> None:
        while not self._stopping:
            self._wait_set.wait(LOOK_INTERVAL_NS)  # nothing ends a wait when ROS is shut down
            if not self._context.ok():
                logger.critical("ROS was shut down from outside the router: nothing can be published any more")
                return
            for event, status in self._wait_set.happened():
                try:
                    event.callback(status)
                except Exception as error:  # noqa: BLE001 told loudly; the next event matters as much
                    logger.critical("a fault in the router itself lost an event; please report it", exc_info=error)


class MessageThread(_WaitThread):
    """Calls `receive[topic]` with each message's CDR bytes and the wall clock ns at which it set out.

    What that raises goes to `failed`, and receiving goes on. Stopping serves what has arrived by then.
    """

    def __init__(
        self,
        node: Node,
        subscriptions: Mapping[str, RawSubscription],
        receive: Mapping[str, Receive],
        failed: Callable[[Exception], None],
    ) -> None:
        self._receive = {subscription: receive[topic] for topic, subscription in subscriptions.items()}
        self._failed = failed
        super().__init__("ros", WaitSet(node, list(self._receive)))

    def _run(self) -> None:
        while not self._stopping:
            self._wait_set.wait()
            for subscription in self._wait_set.ready_subscriptions():
                self._serve(subscription, TURN)
        for subscription in self._receive:
            self._serve(subscription, subscription.capacity)  # no more than that, however fast they come

    def _serve(self, subscription: RawSubscription, most: int) -> None:
        receive = self._receive[subscription]
        for _ in range(most):
            try:
                if (message := subscription.take()) is None:
                    return
                receive(*message)
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, is no reason to stop receiving
                self._failed(error)
