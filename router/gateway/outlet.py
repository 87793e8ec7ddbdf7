"""What becomes of the messages of a gateway's topics: frames, the schema first, and each message in the counters once.

Knows neither clients nor which topics there are: frames go to whoever `deliver` is.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable, Iterable, Sequence

from router.gateway.encoding import LARGE, Encoding
from router.gateway.ledger import Ledger
from router.gateway.samples import Sample
from router.gateway.served import MOST_UNCONVERTED, Served
from router.gateway.style import UnreadableError
from router.gateway.surroundings import Surroundings
from router.gateway.tasks import Tasks
from router.gateway.transport.base import Frame
from router.table.model import EACH, Gateway, Transport


class Outlet:
    """Of one gateway, in the loop's thread. `is_heard` says whether there is anybody to deliver to."""

    def __init__(
        self,
        settings: Gateway,
        around: Surroundings,
        encoding: Encoding,
        ledger: Ledger,
        tasks: Tasks,
        is_heard: Callable[[], bool],
        deliver: Callable[[Sequence[Frame]], None],
    ) -> None:
        self._around = around
        self._encoding = encoding
        self._ledger = ledger
        self._tasks = tasks
        self.is_heard = is_heard
        self._deliver = deliver
        self._introduced: set[Hashable] = set()
        self._pending: list[Frame] = []
        # Datagrams get lost, and the existing gateway's clients expect values to be repeated.
        self._repeats = settings.transport.value is Transport.UDP
        self._most = min(settings.max_message, encoding.most)
        self._remedy = "see `max_message`" if self._most < encoding.most else "use compression or gateway_v2"

    def poll(self, served: Served, frames: list[Frame]) -> None:
        """Adds to `frames` the topic's latest value, if it is to be sent now."""
        if served.is_busy or served.has_ended:
            return
        came = served.came()
        self._ledger.received(came)
        if not self.is_heard():  # the middleware keeps the newest for whoever comes
            self._ledger.filtered(came)
            return
        sample = served.feed.latest() if came or served.sample is None else served.sample
        is_new = came > 0 and sample is not None and sample is not served.sample
        self._ledger.filtered(came - is_new)
        served.sample = sample
        if sample is not None and is_new:
            self._offer(served, sample, frames, is_new=True)
        elif served.readable is not None and self._repeats:
            self._offer(served, served.readable, frames, is_new=False)

    def take(self, served: Served, sample: Sample) -> None:
        """A message of a topic of which every one is sent."""
        served.sample = sample
        self._ledger.received(1)
        if not self.is_heard():
            self._ledger.filtered(1)
        elif not served.is_busy:
            self._offer(served, sample, self._queue(), is_new=True)
        elif len(served.unconverted) < MOST_UNCONVERTED:
            served.unconverted.append(sample)
        else:
            self._ledger.dropped("overloaded", sample.topic)

    def settle(self, served: Served) -> None:
        """Counts what came and gave way to newer messages before anybody could look at it."""
        came = served.came()
        self._ledger.received(came)
        if served.period == EACH:
            self._ledger.dropped("overloaded", served.feed.topic, times=came)
        else:
            self._ledger.filtered(came)

    def end(self, served: Served) -> None:
        """Nothing more of the topic is sent; should it come back, its schema comes first."""
        self.settle(served)
        served.has_ended = True
        self._introduced.discard(self._encoding.introduces(served.feed.topic, served.feed.type_name))

    def _queue(self) -> list[Frame]:
        """Frames that go out together at the end of this turn of the loop."""
        if not self._pending:
            asyncio.get_running_loop().call_soon(self._flush)
        return self._pending

    def _flush(self) -> None:
        frames, self._pending = self._pending, []
        self._deliver(frames)

    def _offer(self, served: Served, sample: Sample, frames: list[Frame], *, is_new: bool) -> None:
        if self._is_quick(sample):
            self._encode(served, sample, frames, is_new=is_new)
        else:
            served.is_busy = True
            self._tasks.run(self._convert(served, sample, is_new=is_new))

    def _is_quick(self, sample: Sample) -> bool:
        return len(sample.cdr) <= LARGE or sample.has_payload(self._encoding.style, self._encoding.level)

    async def _convert(self, served: Served, sample: Sample, *, is_new: bool) -> None:
        """What takes long, in another thread: the topic's next value waits for it, other topics do not."""
        try:
            await asyncio.get_running_loop().run_in_executor(
                self._around.converting, sample.payload, self._encoding.style, self._encoding.level
            )
        except UnreadableError:
            pass  # and will be so again where it is counted
        finally:
            served.is_busy = False
        if served.has_ended:
            self._ledger.filtered(is_new + len(served.unconverted))
            return
        self._encode(served, sample, self._queue(), is_new=is_new)
        while served.unconverted and not served.is_busy:
            self._offer(served, served.unconverted.popleft(), self._queue(), is_new=True)

    def _encode(self, served: Served, sample: Sample, frames: list[Frame], *, is_new: bool) -> None:
        """Adds the value, and before the first of its kind the schema."""
        try:
            data = self._frame(sample)
        except UnreadableError as error:
            if is_new:
                self._ledger.dropped("mapping_error", sample.topic, error)
            return
        served.readable = sample
        if len(data.data) > self._most:
            if is_new:
                detail = f"{len(data.data)} bytes, and at most {self._most} can be sent; {self._remedy}"
                self._ledger.dropped("too_large", sample.topic, detail=detail)
            return
        if is_new:
            self._ledger.sent()
        key = self._encoding.introduces(sample.topic, sample.type_name)
        if key not in self._introduced:
            self._introduced.add(key)
            frames.append(self.schema(served))
        frames.append(data)

    def _frame(self, sample: Sample) -> Frame:
        """Raises UnreadableError."""
        data = self._encoding.data(sample, self._around.wall_s())
        return Frame(data, sample.topic, sample.type_name, is_schema=False)

    # -- for who asks --------------------------------------------------------------------------------------------

    def schema(self, served: Served) -> Frame:
        feed = served.feed
        data = self._encoding.schema(feed.topic, feed.type_name, feed.schema, self._around.wall_s())
        return Frame(data, feed.topic, feed.type_name, is_schema=True)

    def show(self, served: Served, frames: list[Frame]) -> None:
        """Adds schema and latest value. Leaves `served` as it is: what one client is shown, others are still to get.

        A large value that is not converted yet comes to everybody a little later.
        """
        sample = served.feed.latest()
        if sample is None:
            return
        if not self._is_quick(sample):
            frames.append(self.schema(served))
            if not served.is_busy:
                self._offer(served, sample, frames, is_new=False)
            return
        try:
            data = self._frame(sample)
        except UnreadableError:  # which is counted where it is new
            if served.readable is None:
                return
            data = self._frame(served.readable)
        frames.append(self.schema(served))
        if len(data.data) <= self._most:
            frames.append(data)

    def introduced(self, frames: Iterable[Frame]) -> None:
        """Everybody has got the schemas among these."""
        self._introduced |= {self._encoding.introduces(frame.topic, frame.type_name) for frame in frames}
