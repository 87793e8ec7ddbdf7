"""Messages from clients: each is checked, counted, and published on ROS or rejected."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from router.carrier.limits import Freshness, RateLimit
from router.compiler.compiled_table import GatewayPlan, InboundPlan
from router.compiler.metrics import CLIENTS, GATEWAY_REJECT_REASONS, INBOUND_DROP_REASONS, Counters, Report
from router.gateway.documents import CallRequest, PublishRequest, SchemaRequest
from router.gateway.encoding import Encoding
from router.gateway.json_codec import InvalidMessageError, decoder
from router.gateway.json_types import Style
from router.gateway.packets import PacketError, TooLargeError, decompress
from router.log import FloodLog, logger
from router.table.model.gateways import InboundAge

CLOCK_TOLERANCE_NS = 20_000_000
"""How far a client's clock may be ahead without being reported; clocks synchronized by NTP differ less."""


class RefusedError(Exception):
    """A client's message was rejected. `reason` is one of GATEWAY_REJECT_REASONS or INBOUND_DROP_REASONS."""

    def __init__(self, reason: str, detail: str, topic: str = "") -> None:
        super().__init__(detail)
        self.reason = reason
        self.topic = topic


@dataclass(frozen=True, slots=True)
class InboundOutputs:
    """Outputs of an InboundPublisher. Clocks in ns. `library` is the carrier's.

    `publish`, by topic, takes CDR bytes and may raise `publish_errors`. `feed_deadman`, by the deadman's route, is
    called after each published message with the boot clock before publishing.
    """

    library: ctypes.CDLL
    publish: Mapping[str, Callable[[bytes], None]]
    publish_errors: tuple[type[Exception], ...]
    feed_deadman: Mapping[str, Callable[[int], None]]
    report: Callable[[Report], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]


class _Topic:
    """One topic that clients may publish on."""

    def __init__(self, library: ctypes.CDLL, plan: InboundPlan, style: Style, counters: Counters, gateway: str) -> None:
        self.plan = plan
        self.decode = decoder(plan.type, style)
        self.max_rate = plan.settings.topic.max_rate
        self.may_pass = RateLimit(library, self.max_rate).may_pass if self.max_rate is not None else None
        self.published = counters.index("messages_published", gateway, plan.label)
        self.dropped = {
            reason: counters.index("messages_dropped", gateway, plan.label, reason) for reason in INBOUND_DROP_REASONS
        }


class InboundPublisher:
    """Reads the requests of one gateway's clients and publishes their messages.

    Use it only in the thread that owns `counts`. Requests are short (`max_inbound`), so they are read at once.
    Flush `log` regularly.
    """

    def __init__(
        self, plan: GatewayPlan, encoding: Encoding, counters: Counters, counts: list[int], outputs: InboundOutputs
    ) -> None:
        name = plan.settings.name
        self._gateway = name
        self._encoding = encoding
        self._most = plan.settings.max_inbound
        self._topics = {
            topic: _Topic(outputs.library, topic_plan, encoding.style, counters, name)
            for topic, topic_plan in plan.inbound.items()
        }
        self._counts = counts
        self._outputs = outputs
        self._freshness = Freshness(outputs.library)
        self.log = FloodLog()
        self._accepted = counters.index("messages_received", name, CLIENTS)
        self._last = counters.index("route_silence_seconds", name)
        self._clock_ahead = counters.index("gateway_client_clock_ahead", name)
        self._rejected = {
            reason: counters.index("datagrams_rejected", name, reason) for reason in GATEWAY_REJECT_REASONS
        }

    def refusal(self, reason: str, detail: str = "", topic: str = "") -> RefusedError:
        """Count and report a rejection, for one of GATEWAY_REJECT_REASONS. Return the error."""
        self._counts[self._rejected[reason]] += 1
        self._outputs.report(Report("reject", self._gateway, "", reason, None, detail))
        return RefusedError(reason, detail, topic)

    def receive(self, data: bytes, arrived_ns: int) -> SchemaRequest | CallRequest | None:
        """Publish a client's message, or return its request for schemas or its call. `arrived_ns` is wall-clock time.

        Raises RefusedError, which is counted and reported.
        """
        topic = ""
        try:
            request = self._encoding.request(data)
            if isinstance(request, (SchemaRequest, CallRequest)):
                return request
            topic = request.topic
            allowed = self._allowed(request)
            cdr = allowed.decode(self._text(request))
        except PacketError as error:
            reason = "too_large" if isinstance(error, TooLargeError) else "malformed"
            raise self.refusal(reason, str(error), topic) from error
        except InvalidMessageError as error:
            raise self.refusal("invalid", str(error), topic) from error
        self._publish(allowed, cdr, request.time, arrived_ns)
        return None

    def _allowed(self, request: PublishRequest) -> _Topic:
        """Return the topic of a request, if it may be published there. Raises RefusedError, InvalidMessageError."""
        name = request.topic
        topic = self._topics.get(name)
        if topic is None:
            raise self.refusal("not_allowed", f"clients may not publish on '{name[:80]}'", name)
        wanted = topic.plan.type.name
        if request.type_name not in (None, wanted):
            raise self.refusal("wrong_type", f"{name} has the type {wanted}", name)
        self.check_time(name, topic.plan.settings, request.time)
        return topic

    def check_time(self, name: str, limits: InboundAge, time: float | None) -> None:
        """Check the time in a request, if there is a `ttl`. Raises RefusedError, InvalidMessageError."""
        if limits.ttl is None:
            return
        if time is None:
            raise InvalidMessageError(f"{name} requires `time`, the time of sending")
        lead = time - self._outputs.wall_ns() / 1e9
        if lead * 1e9 > limits.max_lead:
            detail = f"{lead:.6g} s in the future, and more than {limits.max_lead / 1e9:g} s; are both clocks right?"
            raise self.refusal("premature", detail, name)

    def _text(self, request: PublishRequest) -> bytes:
        """Return the JSON text of a message. Raises PacketError."""
        if len(request.data) > self._most:
            raise TooLargeError(f"{len(request.data)} bytes exceed the limit of {self._most}")
        return decompress(request.data, self._most) if request.is_compressed else request.data

    def _publish(self, topic: _Topic, cdr: bytes, sent: float | None, arrived_ns: int) -> None:
        """Publish a message. `sent` is the client's wall clock in seconds."""
        self._counts[self._accepted] += 1
        now = self._counts[self._last] = self._outputs.clock_ns()
        if detail := self.staleness(topic.plan.label, topic.plan.settings, sent, arrived_ns, now):
            raise self._dropped(topic, "stale", detail)
        if topic.may_pass and not topic.may_pass(now):
            raise self._dropped(topic, "rate_limited", f"more often than {topic.max_rate:g} Hz")
        try:
            self._outputs.publish[topic.plan.label](cdr)
        except self._outputs.publish_errors as error:
            raise self._dropped(topic, "publish_error", str(error), error) from error
        if topic.plan.deadman is not None:
            self._outputs.feed_deadman[topic.plan.deadman.route](now)
        self._counts[topic.published] += 1

    def staleness(self, name: str, limits: InboundAge, sent: float | None, arrived_ns: int, now: int) -> str:
        """Return a sentence if more than `ttl` has passed since `sent` or the arrival, whichever is earlier.

        If a client's clock is ahead, its messages stay valid for that much longer. The log compares `sent` with the
        present time: if the event loop was blocked, `arrived_ns` is only the earliest possible arrival.
        """
        if limits.ttl is None or sent is None:
            return ""
        ttl, wall = limits.ttl.value, self._outputs.wall_ns()
        stamp = round(min(max(sent, 0.0), arrived_ns / 1e9) * 1e9)
        age = now - self._freshness.times(stamp, wall, now).youngest
        if age > ttl:
            return f"{age / 1e9:.3f} s old, and older than {ttl / 1e9:g} s; are both clocks right?"
        if (ahead := sent - wall / 1e9) * 1e9 > CLOCK_TOLERANCE_NS:
            self._counts[self._clock_ahead] += 1
            self.log.note(
                name,
                logger.warning,
                "a client's clock is ahead, so its messages stay valid for longer than ttl",
                gateway=self._gateway,
                topic=name,
                ahead_s=round(ahead, 3),
                ttl_s=ttl / 1e9,
            )
        return ""

    def _dropped(self, topic: _Topic, reason: str, detail: str, error: Exception | None = None) -> RefusedError:
        """Count an accepted message that is not published, and report it. Return the error."""
        self._counts[topic.dropped[reason]] += 1
        if reason != "rate_limited":  # intended: the table sets the rate
            self._outputs.report(Report("drop", self._gateway, topic.plan.label, reason, error, detail))
        return RefusedError(reason, detail, topic.plan.label)
