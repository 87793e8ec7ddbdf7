"""Handing a message over to where it goes: now, or through what may hold it back."""

from __future__ import annotations

from collections.abc import Callable

from router.engine.outcome import Outcome

Deliver = Callable[[int, bytes, int | None], None]
"""Takes the time, the datagram or the CDR bytes, and the time after which they are stale (None: never).

Monotonic times in ns. What becomes of the message is counted by then or later; it raises nothing of that.
"""

Feed = Callable[[int], None]
"""Tells deadmen that a command is about to be sent, at a time of the monotonic clock in ns."""


def immediately(
    hand_over: Callable[[bytes], object],
    outcome: Outcome,
    failures: tuple[type[Exception], ...] = (OSError,),
    feed: Feed | None = None,
) -> Deliver:
    """Hands over whatever it gets; `hand_over` may raise `failures`. `feed` is called before that."""

    def deliver(now: int, data: bytes, expires: int | None) -> None:
        if feed is not None:
            feed(now)
        try:
            hand_over(data)
        except failures as error:
            outcome.failed(error)
        else:
            outcome.delivered(len(data))

    return deliver


def is_stale(now: int, expires: int | None) -> bool:
    return expires is not None and now > expires
