"""Waits for open files and sockets, also for descriptors above 1023, which `select.select` does not take."""

from __future__ import annotations

import select
from collections.abc import Iterable
from typing import Protocol, TypeVar


class Open(Protocol):
    def fileno(self) -> int: ...


T = TypeVar("T", bound=Open)


def readable(opened: Iterable[T], timeout: float) -> list[T]:
    """Return those that can be read, or have ended, within `timeout` seconds; at least one look if that has passed."""
    poll, by_number = select.poll(), {each.fileno(): each for each in opened}
    for number in by_number:
        poll.register(number, select.POLLIN)
    return [by_number[number] for number, _ in poll.poll(max(0.0, timeout) * 1000)]


def await_room(descriptor: int, timeout: float) -> None:
    """Wait until something can be written, but at most `timeout` seconds."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    poll.poll(timeout * 1000)
