"""Turns the messages of a gateway's topics into frames, the schema first, and counts each message once."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Hashable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field

from router.gateway.clients import Clients
from router.gateway.context import GatewayContext, Tasks
from router.gateway.counters import GatewayCounters
from router.gateway.encoding import LARGE, Encoding, Sample
from router.gateway.json_codec import UnreadableError
from router.gateway.latched import MOST_LATCHED, Fetched
from router.gateway.publishers import Selection
from router.gateway.subscriptions import TopicSubscription
from router.gateway.transport.base import PER_TURN, Frame
from router.table.model.gateways import EACH, Gateway, Transport

MOST_UNCONVERTED = 4
"""Maximum large messages of one topic that wait to be converted, if every message is sent."""

MOST_LOOKS = 20
"""How often to check whether a topic of several publishers is quiet, before giving up."""


@dataclass(slots=True)
class ServedTopic:
    """The state of a topic that a gateway serves.

    `period` is in ns, or EACH for every message; `number` selects the topic's turn within it. `counted` is how many
    messages of `subscription.arrived` are already in the counters (of `subscription.missed` if every message is sent),
    `reported` how many are in the rates for clients. `sample` is the latest message taken, `readable` the latest that
    could be converted. `is_busy` is set while a large message is being converted; `unconverted` ones wait. Latched
    messages that were published up to `refused_ns` and cannot be sent have already been counted. `counted_early` has
    the times of publication (ns) of those that were counted for a late client, and may still arrive on the topic.
    """

    subscription: TopicSubscription
    selection: Selection
    period: int
    number: int
    counted: int = 0
    reported: int = 0
    sample: Sample | None = None
    readable: Sample | None = None
    is_busy: bool = False
    has_ended: bool = False
    refused_ns: int = 0
    counted_early: deque[int] = field(default_factory=lambda: deque(maxlen=MOST_LATCHED))
    seen: int = -1
    looks: int = 0
    unconverted: deque[Sample] = field(default_factory=deque)

    @classmethod
    def begin(cls, subscription: TopicSubscription, selection: Selection, period: int, number: int) -> ServedTopic:
        """Serve a topic from now on.

        If another gateway already has a latest value of the topic, it counts as arriving now: publishers that keep it
        for late joiners do not send it again.
        """
        known = subscription.latest() is not None and not selection.keeps
        arrived = subscription.arrived
        counted = subscription.missed if period == EACH else arrived - known
        return cls(subscription, selection, period, number, counted=counted, reported=arrived)

    def is_quiet(self) -> bool:
        """Return whether nothing has arrived since the last call.

        With several publishers, one may never pause while another keeps messages: after MOST_LOOKS calls, return True.
        """
        before, self.seen = self.seen, self.subscription.arrived
        self.looks = 0 if before == self.seen else self.looks + 1
        if is_quiet := self.looks == 0 or (self.looks > MOST_LOOKS and len(self.selection.keepers) > 1):
            self.seen, self.looks = -1, 0
        return is_quiet

    def uncounted(self) -> int:
        """Return the number of messages since the last call (with EACH, of missed ones), and mark them as counted."""
        total = self.subscription.missed if self.period == EACH else self.subscription.arrived
        new, self.counted = total - self.counted, total
        return new


class TopicSender:
    """Makes frames from messages."""

    def __init__(
        self,
        settings: Gateway,
        context: GatewayContext,
        encoding: Encoding,
        counters: GatewayCounters,
        tasks: Tasks,
        clients: Clients,
    ) -> None:
        self._context = context
        self._encoding = encoding
        self._counters = counters
        self._tasks = tasks
        self._clients = clients
        self._introduced: set[Hashable] = set()
        self._pending: list[Frame] = []
        # Datagrams get lost, and clients of the C++ gateway expect repeated values.
        self._repeats = settings.transport.value is Transport.UDP
        self._most = min(settings.max_outbound, encoding.most)
        self._remedy = "see `max_message`" if self._most < encoding.most else "use tcp, websocket or zenoh"

    def poll(self, served: ServedTopic, frames: list[Frame]) -> None:
        """Append the topic's latest value to `frames` if it is due."""
        if served.is_busy or served.has_ended:
            return
        new = served.uncounted()
        self._counters.received(new)
        if not self._clients:  # the middleware keeps the newest message for later
            self._counters.filtered(new)
            return
        sample = served.subscription.latest() if new or served.sample is None else served.sample
        is_new = new > 0 and sample is not None and sample is not served.sample
        if new > is_new:
            self._counters.filtered(new - is_new)
            if served.selection.keepers:
                self._clients.record_miss(served.subscription.topic)
        served.sample = sample
        if sample is not None and is_new:
            self._offer(served, sample, frames, is_new=True)
        elif served.readable is not None and self._repeats:
            self._offer(served, served.readable, frames, is_new=False)

    def send(self, served: ServedTopic, sample: Sample) -> None:
        """Send a message of a topic with period EACH."""
        served.sample = sample
        self._counters.received(1)
        if not self._clients:
            self._counters.filtered(1)
        elif not served.is_busy:
            self._offer(served, sample, self._queue(), is_new=True)
        elif len(served.unconverted) < MOST_UNCONVERTED:
            served.unconverted.append(sample)
        else:
            self._counters.dropped("overloaded", sample.topic)
            self._clients.record_miss(sample.topic)

    def count_missed(self, served: ServedTopic) -> None:
        """Count messages that newer ones replaced before they were taken."""
        new = served.uncounted()
        self._counters.received(new)
        if served.period == EACH:
            self._counters.dropped("overloaded", served.subscription.topic, messages=new)
            if new:
                self._clients.record_miss(served.subscription.topic)
        else:
            self._counters.filtered(new)

    def end(self, served: ServedTopic) -> None:
        """Stop sending the topic. If it comes back, its schema is sent first."""
        self.count_missed(served)
        served.has_ended = True
        self._introduced.discard(self._encoding.introduces(served.subscription.topic, served.subscription.type_name))

    def _queue(self) -> list[Frame]:
        """Return the list of frames that are sent at the end of this turn of the loop."""
        if not self._pending:
            asyncio.get_running_loop().call_soon(self._flush)
        return self._pending

    def _flush(self) -> None:
        frames, self._pending = self._pending, []
        self._clients.send(frames)

    def _offer(self, served: ServedTopic, sample: Sample, frames: list[Frame], *, is_new: bool) -> None:
        if self._is_quick(sample):
            self._encode(served, sample, frames, is_new=is_new)
        else:
            served.is_busy = True
            if served.readable is not None and served.readable is not sample:
                served.readable.forget()  # its text is large, and soon replaced
            self._tasks.run(self._convert(served, sample, is_new=is_new))

    def _is_quick(self, sample: Sample) -> bool:
        return len(sample.cdr) <= LARGE or sample.has_payload(self._encoding.style, self._encoding.level)

    async def _convert(self, served: ServedTopic, sample: Sample, *, is_new: bool) -> None:
        """Convert a large message in another thread. Only the next value of the same topic waits for it."""
        try:
            await self._prepare(sample)
        finally:
            served.is_busy = False
        if served.has_ended:
            self._counters.filtered(is_new + len(served.unconverted))
            return
        self._encode(served, sample, self._queue(), is_new=is_new)
        while served.unconverted and not served.is_busy:
            self._offer(served, served.unconverted.popleft(), self._queue(), is_new=True)

    async def _prepare(self, sample: Sample) -> None:
        """Convert a message in another thread."""
        with suppress(UnreadableError):  # raised again, and counted, when it is sent
            await asyncio.get_running_loop().run_in_executor(
                self._context.converting, sample.payload, self._encoding.style, self._encoding.level
            )

    def _encode(self, served: ServedTopic, sample: Sample, frames: list[Frame], *, is_new: bool) -> None:
        """Append the value, preceded by the schema if it is the first of its kind."""
        if is_new and sample.sent_ns in served.counted_early:
            served.counted_early.remove(sample.sent_ns)
            self._counters.filtered(1)
            return
        if is_new:
            served.refused_ns = max(served.refused_ns, sample.sent_ns)
        if (data := self._checked(served, sample, is_new=is_new)) is None:
            return
        if is_new:
            self._counters.sent()
        key = self._encoding.introduces(sample.topic, sample.type_name)
        if key not in self._introduced:
            self._introduced.add(key)
            frames.append(self.schema(served))
        frames.append(data)

    def _checked(self, served: ServedTopic, sample: Sample, *, is_new: bool) -> Frame | None:
        """Return the value, or None if it cannot be sent, which is counted if it is new."""
        try:
            data = self._frame(sample)
        except UnreadableError as error:
            if is_new:
                self._counters.dropped("mapping_error", sample.topic, error)
            return None
        if served.readable is None or served.readable.sent_ns < sample.sent_ns:  # not an older one for a late client
            served.readable = sample
        if len(data.data) > self._most:
            if is_new:
                detail = f"{len(data.data)} bytes exceed the limit of {self._most}; {self._remedy}"
                self._counters.dropped("too_large", sample.topic, detail=detail)
            return None
        return data

    def _frame(self, sample: Sample) -> Frame:
        """Encode a message as a frame. Raises UnreadableError if it cannot be converted."""
        data = self._encoding.data(sample, self._context.wall_s())
        return Frame(data, sample.topic, sample.type_name, is_schema=False, sent_ns=sample.sent_ns)

    # -- answers to one client -----------------------------------------------------------------------------------

    def schema(self, served: ServedTopic) -> Frame:
        subscription = served.subscription
        data = self._encoding.schema(
            subscription.topic,
            subscription.type_name,
            subscription.schema(self._encoding.style),
            self._context.wall_s(),
        )
        return Frame(data, subscription.topic, subscription.type_name, is_schema=True)

    async def latched(self, served: ServedTopic, fetched: Fetched) -> AsyncGenerator[Frame, None]:
        """Yield the latched messages, oldest first; then the latest value if others may have sent it."""
        topic = served.subscription
        samples = fetched.samples
        if served.selection.is_mixed and (latest := topic.latest()):
            earlier = [sample for sample in samples if (sample.sent_ns, sample.cdr) != (latest.sent_ns, latest.cdr)]
            samples = [*earlier, latest]
        for number, sample in enumerate(samples, 1):
            if number % PER_TURN == 0:
                await asyncio.sleep(0)
            if (frame := await self._latched_frame(served, fetched, sample)) is not None:
                yield frame._replace(older=len(samples) - number)

    async def _latched_frame(self, served: ServedTopic, fetched: Fetched, sample: Sample) -> Frame | None:
        """Return the frame of a latched message, shared by all clients; None if it cannot be sent, which is counted."""
        key = self, sample
        if (frame := fetched.frame(key)) is not None:
            return frame
        if not self._is_quick(sample):
            await self._prepare(sample)
        is_new = sample.sent_ns > served.refused_ns
        if frame := self._checked(served, sample, is_new=False):
            fetched.remember(key, frame)
        elif is_new:
            self._counters.received(1)
            self._checked(served, sample, is_new=True)
            served.counted_early.append(sample.sent_ns)
        served.refused_ns = max(served.refused_ns, sample.sent_ns)
        sample.forget()
        return frame

    def show(self, served: ServedTopic, frames: list[Frame]) -> None:
        """Append schema and latest value; only the schema if publishers keep messages.

        Does not change `served`: other clients still get the value. A large value that has not been converted yet is
        sent to all clients a little later.
        """
        if served.selection.keepers:
            frames.append(self.schema(served))
            return
        sample = served.subscription.latest()
        if sample is None:
            return
        if not self._is_quick(sample):
            frames.append(self.schema(served))
            if not served.is_busy:
                self._offer(served, sample, frames, is_new=False)
            return
        try:
            data = self._frame(sample)
        except UnreadableError:  # counted where it is new
            if served.readable is None:
                return
            data = self._frame(served.readable)
        frames.append(self.schema(served))
        if len(data.data) <= self._most:
            frames.append(data)

    def introduced(self, frames: Iterable[Frame]) -> None:
        """Record that all clients have the schemas among `frames`."""
        self._introduced |= {self._encoding.introduces(frame.topic, frame.type_name) for frame in frames}
