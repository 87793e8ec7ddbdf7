"""The two threads that wait on ROS. Events have one of their own because a wait set is needed for them, and a turn
costs what the wait set holds: with a rover's topics, more than a message does.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import partial

from rclpy.event_handler import EventHandler
from rclpy.node import Node

from router.clock import monotonic_ns
from router.log import logger
from router.ros.arrivals import Arrivals, RawSubscription
from router.ros.wait import WaitSet
from router.threads import paused

Receive = Callable[[bytes, int], None]

LOOK_INTERVAL_NS = 1_000_000_000
"""How long something may go unnoticed that ends no wait: events of subscriptions, incompatible peers that have left,
and a shutdown by somebody else."""

TURN = 32
"""Messages of one topic that are served before others have their turn."""


class _WaitThread(ABC):
    """Waits and serves in turn until it is stopped. It starts once and stops once."""

    def __init__(self, name: str, waits_on: WaitSet | Arrivals) -> None:
        self._waits_on = waits_on
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping = True
        self._waits_on.wake()
        self._thread.join()
        self._waits_on.close()

    @abstractmethod
    def _run(self) -> None: ...


class EventThread(_WaitThread):
    """Calls the callbacks of events: those of publishers when they happen, those of subscriptions at most 1 s later.

    Nobody waits for the latter, because Fast DDS would end the wait for each message, and at once while one is there
    that the other thread has not taken yet: two threads would fight for the interpreter just when there is no time.
    """

    def __init__(
        self,
        node: Node,
        of_publishers: Sequence[EventHandler],
        of_subscriptions: Sequence[EventHandler],
        look: Callable[[], None],
    ) -> None:
        """`look` is called once per second, after the callbacks."""
        self._waited_for = WaitSet(node, of_publishers)
        super().__init__("ros events", self._waited_for)
        self._looked_at = WaitSet(node, of_subscriptions)
        self._context = node.context
        self._look = look

    def stop(self) -> None:
        super().stop()
        self._looked_at.close()

    def _run(self) -> None:
        look_at = 0
        while not self._stopping:
            self._waited_for.wait(max(0, look_at - monotonic_ns()))
            if not self._context.ok():
                logger.critical("ROS was shut down from outside the router: nothing can be published any more")
                return
            self._serve(self._waited_for)
            if (now := monotonic_ns()) >= look_at:
                look_at = now + LOOK_INTERVAL_NS
                self._looked_at.wait(0)
                self._serve(self._looked_at)
                self._call(self._look)

    def _serve(self, wait_set: WaitSet) -> None:
        for event, status in wait_set.happened():
            self._call(partial(event.callback, status))

    def _call(self, callback: Callable[[], None]) -> None:
        try:
            callback()
        except Exception as error:  # noqa: BLE001 told loudly; the next event matters as much
            logger.critical("a fault in the router itself lost an event; please report it", exc_info=error)


class MessageThread(_WaitThread):
    """Gives each message's CDR bytes, and the wall clock ns at which it set out, to whoever `serve` names.

    What that raises goes to `failed`, and receiving goes on. Stopping serves what has arrived by then.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        """Raises one of `ros_node.RCL_ERRORS`."""
        self._receive: dict[RawSubscription, Receive] = {}
        self._failed = failed
        self._arrivals = Arrivals([])
        self._tasks: deque[Callable[[], None]] = deque()
        super().__init__("ros", self._arrivals)

    @classmethod
    def serving(cls, receive: Mapping[RawSubscription, Receive], failed: Callable[[Exception], None]) -> MessageThread:
        """One that has started, with these to serve. Raises one of `ros_node.RCL_ERRORS`."""
        thread = cls(failed)
        with ExitStack() as opening:
            opening.callback(thread._arrivals.close)
            thread.serve(receive)  # before it looks: what has arrived by now is told of at once
            thread.start()
            opening.pop_all()
        return thread

    def paused(self) -> AbstractContextManager[None]:
        """The thread takes nothing meanwhile. Raises StuckError."""
        return paused(self._ask)

    def serve(self, receive: Mapping[RawSubscription, Receive]) -> None:
        """From now on these and no others, each by its function. To be called before the start, or while paused.

        Raises one of `ros_node.RCL_ERRORS`, or OSError, and then all is as it was.
        """
        with ExitStack() as adding:
            for subscription in receive.keys() - self._receive.keys():
                self._arrivals.add(subscription)
                adding.callback(self._arrivals.remove, subscription)
            adding.pop_all()
        for subscription in self._receive.keys() - receive.keys():
            self._arrivals.remove(subscription)
        self._receive = dict(receive)

    def finish(self, subscription: RawSubscription) -> list[tuple[bytes, int]]:
        """Serves what has arrived on one that is not served any more afterwards, and returns it. While paused."""
        messages = subscription.take_all()
        for message in messages:
            self._hand_on(self._receive[subscription], message)
        return messages

    def _ask(self, task: Callable[[], None]) -> None:
        self._tasks.append(task)
        self._waits_on.wake()

    def _run(self) -> None:
        while not self._stopping:
            for subscription in self._arrivals.wait():
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
                receive(*message)
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, is no reason to stop receiving
                self._failed(error)
        self._arrivals.again(subscription)

    def _hand_on(self, receive: Receive, message: tuple[bytes, int]) -> None:
        try:
            receive(*message)
        except Exception as error:  # noqa: BLE001 as above
            self._failed(error)
