"""A wait set for events that is made once: rclpy's executor makes one for each turn.

Which thread waits is not known here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node


class WaitSet:
    """Waits until one of these has happened. For one thread; `wake` is for the others."""

    def __init__(self, node: Node, events: Sequence[EventHandler]) -> None:
        self._events = events
        self._guard = GuardCondition(None, None, node.context)
        self._set = rclpy_implementation.WaitSet(0, 1, 0, 0, 0, len(events), node.context.handle)

    def wait(self, timeout_ns: int) -> None:
        """Until something happens or `wake` is called, at most `timeout_ns`.

        No Python runs in this thread meanwhile, signal handlers included.
        """
        waiting = self._set
        waiting.clear_entities()  # waiting takes out what is not ready
        waiting.add_guard_condition(self._guard.handle)
        for event in self._events:
            event.add_to_wait_set(waiting)
        waiting.wait(timeout_ns)

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
