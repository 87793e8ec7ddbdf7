"""The names of a table as tests use them: looked up, or a finding with the nearest one that there is."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

from router.compiler import Checked
from router.compiler.program import Program
from router.engine.dispatch import Peer
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean
from router.table.addresses import BadAddressError, parse_address
from router.table.model import Endpoint
from router.table.reading import InvalidValueError
from router.types.model import Enum, MessageType
from router.types.protobuf import PayloadCase

_PORT = 40_000
"""A sender's port where nothing else is said."""


class Names:
    """Each method takes a name and the place where it is written, and raises InvalidValueError if there is none."""

    def __init__(self, checked: Checked) -> None:
        assert checked.program is not None  # noqa: S101 - whoever tests a table has seen to that
        self.program: Program = checked.program
        self.checked = checked
        self._table = self.program.table

    def case(self, name: str, span: SourceSpan) -> PayloadCase:
        cases = self.program.envelope.cases
        if name not in cases:
            message = f"{self.program.envelope.name} has no payload case '{name}'"
            raise unsound(span, Code.UNKNOWN_PAYLOAD_CASE, message, did_you_mean(name, cases))
        return cases[name]

    def peer(self, name: str, span: SourceSpan) -> Peer:
        """The address that an endpoint sends from, or any other that is written HOST:PORT."""
        if endpoint := self._table.endpoints.get(name):
            address = endpoint.address.value
            return address.host, endpoint.source_port.value if endpoint.source_port else address.port
        host, colon, port = name.partition(":")
        try:
            return parse_address(f"{'127.0.0.1' if host == 'localhost' else host}:{port if colon else _PORT}")
        except BadAddressError as error:
            message = f"'{name}' is neither HOST[:PORT] nor a name of the route table"
            raise unsound(span, Code.UNKNOWN_ENDPOINT, message, did_you_mean(name, self._table.endpoints)) from error

    def listener(self, name: str, span: SourceSpan) -> str:
        self._known(name, self._table.listeners, span, "listener", Code.BAD_VALUE)
        return name

    def believed_by(self, sender: str) -> str | None:
        """The listener of an endpoint, if it is one that has one."""
        endpoint = self._table.endpoints.get(sender)
        return endpoint.listener.value if endpoint and endpoint.listener else None

    @property
    def listeners(self) -> tuple[str, ...]:
        return tuple(self._table.listeners)

    def endpoint(self, name: str, span: SourceSpan) -> Endpoint:
        """One that something is sent to."""
        self._known(name, self._table.endpoints, span, "endpoint", Code.UNKNOWN_ENDPOINT)
        destinations = [endpoint.name for endpoint in self.program.senders]
        self._known(name, destinations, span, "route to the endpoint", Code.UNKNOWN_ENDPOINT)
        return self._table.endpoints[name]

    def route(self, name: str, span: SourceSpan) -> str:
        routes = [route.name for route in self._table.routes if not route.ignore]
        self._known(name, routes, span, "route", Code.BAD_VALUE)
        return name

    def published(self, name: str, span: SourceSpan) -> MessageType:
        self._known(name, self._published, span, "route that publishes on", Code.BAD_VALUE)
        return self._published[name]

    def subscribed(self, name: str, span: SourceSpan) -> MessageType:
        self._known(name, self._subscribed, span, "route from the topic", Code.BAD_VALUE)
        return self._subscribed[name]

    def target(self, name: str, span: SourceSpan) -> str:
        """An endpoint or a topic that a route delivers to."""
        known = [*(endpoint.name for endpoint in self.program.senders), *self._published]
        self._known(name, known, span, "route to", Code.BAD_VALUE)
        return name

    @property
    def enums(self) -> Iterable[Enum]:
        return () if self.checked.schema is None else self.checked.schema.enums.values()

    @cached_property
    def _published(self) -> dict[str, MessageType]:
        targets = [target for route in self.checked.routes for target in route.targets]
        return {target.topic.topic.value: target.type for target in targets if target.topic and target.type}

    @cached_property
    def _subscribed(self) -> dict[str, MessageType]:
        return {feed.topic.topic.value: feed.type for route in self.checked.routes for feed in route.subscriptions}

    def _known(self, name: str, known: Iterable[str], span: SourceSpan, what: str, code: Code) -> None:
        names = list(known)
        if name not in names:
            raise unsound(span, code, f"{self._table.path.name} has no {what} '{name}'", did_you_mean(name, names))


def unsound(span: SourceSpan, code: Code, message: str, hint: str = "") -> InvalidValueError:
    return InvalidValueError(Diagnostic(span, code, message, hint))
