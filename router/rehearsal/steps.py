"""The steps of a table test: what is given and expected, as data with its places, and the readers of both.

Every name must be in the table under test; otherwise InvalidValueError is raised, with the nearest name in the table.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from router.compiler import Checked
from router.compiler.checked import CheckedCalled, CheckedService
from router.compiler.compiled_table import CompiledTable, StatePlan, is_service, service_label
from router.compiler.expressions.tree import ENVELOPE
from router.compiler.metrics import DROP_REASONS, REJECT_REASONS
from router.compiler.network import takes_from
from router.compiler.resolution import PORT_IN_TESTS, sender_in_tests
from router.datagrams import Peer
from router.errors import Code, Located, SourceSpan, did_you_mean
from router.hosts import LOOPBACK, with_port
from router.rehearsal.fields import ANY, FieldReader, Fields
from router.rehearsal.stage import UNMATCHED
from router.table.addresses import BadAddressError, is_host, parse_address
from router.table.nodes import Entry, MappingNode, Node, ScalarNode, SequenceNode
from router.table.reading import InvalidValueError, boolean, integer, optional_text, parsed
from router.table.units import parse_duration
from router.types.model import MessageType
from router.types.protobuf import PayloadCase

UNCHANGED = "unchanged"

Counts = Mapping[str, int]
"""How many of each reason, or for each target."""


@dataclass(frozen=True, slots=True)
class Given:
    """A message that arrives `times` times, `every` ns, each sent `age` ns before.

    With a `topic` it is a ROS message, with `call` the request of a client, with `answer` the response of a server,
    both by the label of their service. Otherwise it is a datagram from `peer` at `listener`. The content of a message
    is `fields`, that of a datagram `payloads`, by payload case, and `beside` of the envelope; or either has the bytes
    `data`. `pad` in bytes, 0 for none.
    """

    span: SourceSpan
    topic: str | None = None
    call: str | None = None
    answer: str | None = None
    peer: Peer = ("", 0)
    listener: str = ""
    payloads: Sequence[tuple[PayloadCase, Fields]] = ()
    fields: Fields | None = None
    beside: Fields | None = None
    data: bytes | None = None
    trim: bool = False
    pad: int = 0
    times: int = 1
    every: int = 0
    age: int = 0


@dataclass(frozen=True, slots=True)
class Delivery:
    """One expected delivery: the datagram as it was given, these bytes, or a message with these fields.

    `case` is the payload of a datagram, `beside` has fields of its envelope. If none of these is given, any content is
    accepted.
    """

    span: SourceSpan
    is_unchanged: bool = False
    data: bytes | None = None
    case: PayloadCase | None = None
    fields: Fields | None = None
    beside: Fields | None = None

    @property
    def is_compared(self) -> bool:
        """Whether the test compares the content, and not only the payload case."""
        return self.is_unchanged or self.data is not None or self.fields is not None


Deliveries = Mapping[str, tuple[Delivery, ...]]
"""By endpoint or topic, in order."""


@dataclass(frozen=True, slots=True)
class Expected:
    """Everything that may happen in a step. With `anything`, nothing is compared.

    `published` also has what `answered` and `called` expect, by the label of the service.

    `rejected`, `filtered` and `route` are None if the test does not mention them. `obeyed` and `disobeyed` count
    endpoints that begin to obey the brake of a deadman, or to disobey it. `states` are at the end of the step, as the
    table writes their values.
    """

    span: SourceSpan
    anything: bool = False
    sent: Deliveries = field(default_factory=dict)
    published: Deliveries = field(default_factory=dict)
    dropped: Mapping[str, Located[Counts]] = field(default_factory=dict)
    rejected: Located[Counts] | None = None
    filtered: Located[Counts] | None = None
    obeyed: Located[Counts] | None = None
    disobeyed: Located[Counts] | None = None
    route: Located[str] | None = None
    states: Mapping[str, Located[str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Step:
    """`at` and `until` in ns after the beginning of the test; None for the end of the previous step."""

    span: SourceSpan
    expected: Expected
    given: Given | None = None
    at: int | None = None
    until: int | None = None
    stop: bool = False


# Names


class Names:
    """The names of a table. Methods take a name and its place, and raise InvalidValueError for an unknown name."""

    def __init__(self, checked: Checked, program: CompiledTable) -> None:
        self._checked = checked
        self._program = program
        self._table = program.table

    @cached_property
    def constants(self) -> Mapping[str, set[int]]:
        """The numbers of enum values by name, plain and with the name of their enum."""
        numbers: dict[str, set[int]] = {}
        for enum in self._program.envelopes.enums:
            for name, number in enum.values:
                for known in (name, f"{enum.name.rpartition('.')[2]}.{name}"):
                    numbers.setdefault(known, set()).add(number)
        return numbers

    def case(self, name: str, span: SourceSpan) -> PayloadCase:
        envelopes = self._program.envelopes
        if name not in envelopes.cases:
            raise InvalidValueError(span, Code.UNKNOWN_PAYLOAD_CASE, *envelopes.unknown_case(name))
        return envelopes.cases[name]

    @property
    def cases(self) -> Collection[str]:
        return self._program.envelopes.cases

    def beside(self, case: PayloadCase) -> MessageType:
        """The fields of the envelope of a payload case beside the payload."""
        return self._program.envelopes.of(case.name).beside

    def beside_to(self, endpoint: str) -> MessageType:
        """The fields beside the payload of the envelope that an endpoint gets."""
        return self._program.envelopes.to(endpoint).beside

    def peer(self, name: str, span: SourceSpan) -> Peer:
        """Return the address that an endpoint sends from, or an address written HOST[:PORT]."""
        if endpoint := self._table.endpoints.get(name):
            return sender_in_tests(self._table, endpoint)
        text = re.sub(r"^localhost(?=:|$)", LOOPBACK, name)
        try:
            return parse_address(with_port(text, PORT_IN_TESTS) if is_host(text) else text)
        except BadAddressError as error:
            message = f"'{name}' is neither HOST[:PORT] nor a name of the route table"
            raise InvalidValueError(
                span, Code.UNKNOWN_ENDPOINT, message, did_you_mean(name, self._table.endpoints)
            ) from error

    def listener(
        self,
        named: Located[str] | None,
        sender: str,
        host: str,
        payloads: Sequence[tuple[PayloadCase, Fields]],
        span: SourceSpan,
    ) -> str:
        """Return the listener that is named, else the one at which the sender is accepted, else the only one.

        The only one is among those that receive the envelope of the payloads, and from addresses like the sender's.
        """
        listeners = self._table.listeners
        if named is not None:
            name = self._known(named.value, listeners, named.span, "listener")
            if not takes_from(listeners[name], host):
                message = f"nothing arrives from {host} at '{name}': only one of them is IPv6"
                raise InvalidValueError(named.span, Code.BAD_VALUE, message)
            return name
        endpoint = self._table.endpoints.get(sender)
        if endpoint is not None and endpoint.listener is not None:
            return endpoint.listener.value
        envelopes = self._program.envelopes
        around = [envelopes.of(case.name) for case, _ in payloads]
        near = [name for name, each in listeners.items() if takes_from(each, host)]
        fitting = [name for name in near if not around or envelopes.at(name) is around[0]]
        if len(fitting) != 1:
            raise InvalidValueError(span, Code.MISSING_KEY, f"name the listener: {', '.join(fitting or listeners)}")
        return fitting[0]

    def endpoint(self, name: str, span: SourceSpan) -> str:
        """Return an endpoint that something is sent to."""
        self._known(name, self._table.endpoints, span, "endpoint", Code.UNKNOWN_ENDPOINT)
        return self._known(name, self._destinations, span, "route to the endpoint", Code.UNKNOWN_ENDPOINT)

    def watched(self, name: str, span: SourceSpan) -> str:
        """Return an endpoint that shows whether it obeys a deadman."""
        watched = [endpoint for plan in self._program.deadmen if plan.obeyed for endpoint in plan.obeyed.endpoints]
        return self._known(name, watched, span, "deadman with `obeyed` for the endpoint", Code.UNKNOWN_ENDPOINT)

    def route(self, name: str, span: SourceSpan) -> str:
        return self._known(name, [route.name for route in self._table.routes if not route.ignore], span, "route")

    def published(self, name: str, span: SourceSpan) -> tuple[str, MessageType]:
        """Return a topic with its type."""
        topics = [topic for topic in self._published if not is_service(topic)]
        return self._known(name, topics, span, "route that publishes on"), self._published[name]

    def subscribed(self, name: str, span: SourceSpan) -> tuple[str, MessageType]:
        """Return a topic with its type."""
        return self._known(name, self._subscribed, span, "route from the topic"), self._subscribed[name]

    def request(self, name: str, span: SourceSpan) -> tuple[str, MessageType]:
        """Return the label of a service that an endpoint answers, with the type of its requests."""
        return service_label(name), self._service(name, span).request_type

    def response(self, name: str, span: SourceSpan) -> tuple[str, MessageType]:
        """Likewise, with the type of its responses."""
        return service_label(name), self._service(name, span).response_type

    def _service(self, name: str, span: SourceSpan) -> CheckedService:
        services = {each.declared.name: each for each in self._checked.services}
        return services[self._known(name, services, span, "service that an endpoint answers:")]

    def called_request(self, name: str, span: SourceSpan) -> tuple[str, MessageType]:
        """Return the label of a service that an endpoint calls, with the type of its requests."""
        return service_label(name), self._called(name, span).request_type

    def called_response(self, name: str, span: SourceSpan) -> tuple[str, MessageType]:
        """Likewise, with the type of its responses."""
        return service_label(name), self._called(name, span).response_type

    def _called(self, name: str, span: SourceSpan) -> CheckedCalled:
        services = {each.declared.name: each for each in self._checked.called}
        return services[self._known(name, services, span, "service that an endpoint calls:")]

    def target(self, name: str, span: SourceSpan) -> str:
        """Return an endpoint or a topic that a route delivers to, a state as `state.NAME`, or likewise a service."""
        states = [state.label for state in self._program.states]
        return self._known(name, [*self._destinations, *self._published, *states], span, "route to")

    def state(self, name: str, span: SourceSpan) -> StatePlan:
        states = {state.name: state for state in self._program.states}
        return states[self._known(name, states, span, "state", Code.UNKNOWN_STATE)]

    @cached_property
    def _destinations(self) -> Sequence[str]:
        return [endpoint.name for endpoint in self._program.senders]

    @cached_property
    def _published(self) -> Mapping[str, MessageType]:
        targets = [target for route in self._checked.routes for target in route.targets]
        return {target.topic.topic.value: target.type for target in targets if target.topic and target.type}

    @cached_property
    def _subscribed(self) -> Mapping[str, MessageType]:
        subscriptions = [subscription for route in self._checked.routes for subscription in route.subscriptions]
        subscriptions += [state.feed for state in self._checked.states.values() if state.feed is not None]
        types = {subscription.topic.topic.value: subscription.type for subscription in subscriptions}
        return {topic: kind for topic, kind in types.items() if not is_service(topic)}

    def _known(self, name: str, names: Iterable[str], span: SourceSpan, what: str, code: Code = Code.BAD_VALUE) -> str:
        known = list(names)
        if name not in known:
            raise InvalidValueError(
                span, code, f"{self._table.path.name} has no {what} '{name}'", did_you_mean(name, known)
            )
        return name


# given


_KEYS_OF_DATAGRAMS = ("case", "fields", "cases", "envelope", "from", "listener", "trim", "pad")
_MESSAGES = {"topic": ("message", "a ROS message"), "call": ("request", "a call"), "answer": ("response", "an answer")}
"""What arrives from ROS: the key that names it, the key of its content, and what it is."""


class GivenReader:
    def __init__(self, names: Names) -> None:
        self._names = names
        self._fields = FieldReader(names.constants, exact=True)

    def given(self, node: Node) -> Given:
        """Read the given message of a step. Raises InvalidValueError."""
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        span = next(iter(node.entries.values())).key.span if node.entries else node.span
        key = next((key for key in _MESSAGES if key in node.entries), None)
        return self._datagram(span, node) if key is None else self._message(span, node, key)

    def _datagram(self, span: SourceSpan, node: MappingNode) -> Given:
        _refuse(node, [content for content, _ in _MESSAGES.values()], "a datagram", _KEYS_OF_DATAGRAMS)
        sender = optional_text(node, "from")
        if sender is None:
            raise InvalidValueError(span, Code.MISSING_KEY, "this datagram has no sender", "add 'from: ENDPOINT'")
        data, forms = _hex(node), [key for key in ("case", "cases", "hex") if key in node.entries]
        if len(forms) != 1:
            message = "write a datagram as 'case' with 'fields', as 'cases' or as 'hex', a ROS message with 'topic'"
            raise InvalidValueError(span, Code.BAD_VALUE, message, "services have 'call' and 'answer'")
        for key, needed in (("fields", ["case"]), ("envelope", ["case", "cases"])):
            if (entry := node.entries.get(key)) and forms[0] not in needed:
                raise InvalidValueError(entry.key.span, Code.UNKNOWN_KEY, f"'{key}' needs 'case'")
        payloads = [*self._payloads(span, node)]
        peer = self._names.peer(sender.value, sender.span)
        pad = integer(node, "pad")
        times, every, age = _repetition(node)
        return Given(
            span=span,
            peer=peer,
            listener=self._names.listener(optional_text(node, "listener"), sender.value, peer[0], payloads, span),
            payloads=payloads,
            beside=self._content(self._names.beside(payloads[0][0]), node.get("envelope"), span) if payloads else None,
            data=data,
            trim=boolean(node, "trim"),
            pad=pad.value if pad else 0,
            times=times,
            every=every,
            age=age,
        )

    def _payloads(self, span: SourceSpan, node: MappingNode) -> Iterator[tuple[PayloadCase, Fields]]:
        if (named := optional_text(node, "case")) is not None:
            case = self._names.case(named.value, named.span)
            yield case, self._content(case.type, node.get("fields"), span)
        several = node.get("cases")
        for name, entry in several.entries.items() if isinstance(several, MappingNode) else ():
            case = self._names.case(name, entry.key.span)
            yield case, self._content(case.type, entry.value, entry.key.span)

    def _message(self, span: SourceSpan, node: MappingNode, key: str) -> Given:
        content, what = _MESSAGES[key]
        others = [*_MESSAGES, *(other for other, _ in _MESSAGES.values()), *_KEYS_OF_DATAGRAMS]
        refused = [other for other in others if other not in {key, content}]
        _refuse(node, [*refused, "age"] if key == "answer" else refused, what, (key, content))
        named = optional_text(node, key)
        assert named is not None  # noqa: S101 - the key is there
        find = {"topic": self._names.subscribed, "call": self._names.request, "answer": self._names.called_response}
        name, kind = find[key](named.value, named.span)
        data, message = _hex(node), node.get(content)
        if data is not None and message is not None:
            raise InvalidValueError(span, Code.BAD_VALUE, f"{what} has '{content}' or 'hex', not both")
        fields = self._content(kind, message, named.span) if data is None else None
        times, every, age = _repetition(node)
        return Given(
            span,
            topic=name if key == "topic" else None,
            call=name if key == "call" else None,
            answer=name if key == "answer" else None,
            fields=fields,
            data=data,
            times=times,
            every=every,
            age=age,
        )

    def _content(self, kind: MessageType, node: Node | None, span: SourceSpan) -> Fields:
        return self._fields.message(kind, node) if node else Fields(kind, {}, span)


def _refuse(node: MappingNode, names: Iterable[str], what: str, known: tuple[str, ...]) -> None:
    for name in names:
        if entry := node.entries.get(name):
            hint = f"its keys are {', '.join((*known, 'hex'))}"
            raise InvalidValueError(entry.key.span, Code.UNKNOWN_KEY, f"{what} has no key '{name}'", hint)


def _repetition(node: MappingNode) -> tuple[int, int, int]:
    """Return `times`, `every` and `age`, the latter two in ns."""
    times, every, age = integer(node, "times"), optional_text(node, "every"), optional_text(node, "age")
    if every is not None and times is None:
        raise InvalidValueError(
            every.span, Code.MISSING_KEY, "'every' without 'times'", "add 'times', the number of messages"
        )
    return (
        times.value if times else 1,
        parsed(parse_duration, every) if every else 0,
        parsed(parse_duration, age) if age else 0,
    )


def _hex(node: MappingNode) -> bytes | None:
    text = optional_text(node, "hex")
    return bytes.fromhex(text.value) if text else None


# expect


_MOST = 100_000

_Find = Callable[[str, SourceSpan], tuple[str, MessageType]]
"""Finds the target and the type of messages by the name that a test uses."""


class ExpectedReader:
    def __init__(self, names: Names) -> None:
        self._names = names
        self._fields = FieldReader(names.constants, exact=False)
        self._given = FieldReader(names.constants, exact=True)

    def expected(self, span: SourceSpan, node: Node, given: Node | None) -> Expected:
        """Read what a step expects; 'unchanged' refers to `given`, the step's message. Raises InvalidValueError."""
        if isinstance(node, ScalarNode):
            return Expected(span, anything=node.text == ANY)
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        route, rejected = node.entries.get("route"), node.entries.get("rejected")
        return Expected(
            span=span,
            sent=self._sent(node.get("sent"), given),
            published={
                **self._published(node.get("published"), given, self._names.published),
                **self._published(node.get("answered"), given, self._names.response),
                **self._published(node.get("called"), given, self._names.called_request),
            },
            dropped=self._dropped(node.get("dropped")),
            rejected=Located(_reasons(rejected.value, REJECT_REASONS), rejected.key.span) if rejected else None,
            filtered=self._counted(node.entries.get("filtered"), self._names.target),
            obeyed=self._counted(node.entries.get("obeyed"), self._names.watched),
            disobeyed=self._counted(node.entries.get("disobeyed"), self._names.watched),
            route=Located(self._names.route(*_name(route.value)), route.value.span) if route else None,
            states=self._states(node.get("state")),
        )

    def _states(self, node: Node | None) -> Mapping[str, Located[str]]:
        entries = node.entries.items() if isinstance(node, MappingNode) else ()
        return {name: _state(self._names.state(name, entry.key.span), entry.value) for name, entry in entries}

    def _sent(self, node: Node | None, given: Node | None) -> Deliveries:
        if not isinstance(node, MappingNode):
            named = [_name(item) for item in _listed(node)]
            _refuse_repeated(named)
            return {self._names.endpoint(name, span): (_unchanged(span, given),) for name, span in named}
        return {
            self._names.endpoint(name, entry.key.span): tuple(
                delivery for one in _listed(entry.value) for delivery in self._datagrams(name, one, given)
            )
            for name, entry in node.entries.items()
        }

    def _datagrams(self, endpoint: str, node: Node, given: Node | None) -> Sequence[Delivery]:
        if isinstance(node, ScalarNode):
            return [_of_word(node, given)]
        if not isinstance(node, MappingNode):
            raise InvalidValueError(node.span, Code.WRONG_TYPE, "a list within a list is not a datagram")
        times, around = _times(node), self._around(node)
        content = [(name, entry) for name, entry in node.entries.items() if name != "times" and entry is not around]
        beside = self._fields.message(self._names.beside_to(endpoint), around.value) if around else None
        if not content and around is None:
            return [_unchanged(node.span, given)] * times
        if around is not None and (not content or "hex" in node.entries):
            raise InvalidValueError(node.span, Code.MISSING_KEY, f"'{ENVELOPE}' needs a payload case beside it")
        return [self._datagram(name, entry, given, beside) for name, entry in content] * times

    def _around(self, node: MappingNode) -> Entry | None:
        """Return the entry for fields beside the payload, unless it is a payload case of that name."""
        return None if ENVELOPE in self._names.cases else node.entries.get(ENVELOPE)

    def _datagram(self, name: str, entry: Entry, given: Node | None, beside: Fields | None) -> Delivery:
        if name == "hex":
            return Delivery(entry.key.span, data=_bytes(entry.value))
        case = self._names.case(name, entry.key.span)
        fields = None if _is(entry.value, ANY) else self._content(case.type, entry.value, given)
        return Delivery(entry.key.span, case=case, fields=fields, beside=beside)

    def _published(self, node: Node | None, given: Node | None, find: _Find) -> Deliveries:
        deliveries: dict[str, tuple[Delivery, ...]] = {}
        for name, entry in node.entries.items() if isinstance(node, MappingNode) else ():
            span, listed = entry.key.span, _listed(entry.value)
            target, kind = find(name, span)
            found = (delivery for one in listed for delivery in self._messages(kind, span, one, given))
            deliveries[target] = tuple(found)
        return deliveries

    def _messages(self, kind: MessageType, span: SourceSpan, node: Node, given: Node | None) -> Sequence[Delivery]:
        times = 1
        if isinstance(node, MappingNode) and set(node.entries) == {"message", "times"}:
            times = _times(node)
            node = node.entries["message"].value
        fields = None if _is(node, ANY) else self._content(kind, node, given)
        return [Delivery(span, fields=fields)] * times

    def _content(self, kind: MessageType, node: Node, given: Node | None) -> Fields:
        """Return the fields as written; for 'unchanged', those of the step's given message."""
        if not _is(node, UNCHANGED):
            return self._fields.message(kind, node)
        if not isinstance(given, MappingNode) or given.entries.keys() & {"hex", "cases"}:
            raise InvalidValueError(node.span, Code.BAD_VALUE, "'unchanged' needs fields that are given in this step")
        contents = ["fields", *(content for content, _ in _MESSAGES.values())]
        fields = next((given.get(content) for content in contents if content in given.entries), None)
        return self._given.message(kind, fields) if fields else Fields(kind, {}, node.span)

    def _dropped(self, node: Node | None) -> Mapping[str, Located[Counts]]:
        entries, known = node.entries.items() if isinstance(node, MappingNode) else (), (*DROP_REASONS, UNMATCHED)
        return {
            self._names.target(name, entry.key.span): Located(_reasons(entry.value, known), entry.key.span)
            for name, entry in entries
        }

    def _counted(self, entry: Entry | None, known: Callable[[str, SourceSpan], str]) -> Located[Counts] | None:
        """Return a name, a list of them, or how many of each."""
        if entry is None:
            return None
        node = entry.value
        if isinstance(node, MappingNode):
            counts = {known(name, counted.key.span): _count(counted.value) for name, counted in node.entries.items()}
            return Located(counts, entry.key.span)
        return Located(Counter(known(*_name(item)) for item in _listed(node)), entry.key.span)


def _state(plan: StatePlan, node: Node) -> Located[str]:
    """Return the expected value of a state, as the table writes it."""
    text, span = _name(node)
    if plan.values is not None and text not in plan.values:
        message = f"'{text}' is not a value of the state '{plan.name}'"
        raise InvalidValueError(span, Code.BAD_VALUE, message, did_you_mean(text, plan.values))
    return Located(plan.shown(text) if plan.is_text else text, span)


def _reasons(node: Node, known: Iterable[str]) -> Counts:
    """Return a reason, a list of them, or how many of each."""
    if isinstance(node, MappingNode):
        named = [(name, entry.key.span) for name, entry in node.entries.items()]
    else:
        named = [_name(item) for item in _listed(node)]
    for name, span in named:
        if name not in known:
            raise InvalidValueError(span, Code.BAD_VALUE, f"there is no reason '{name}'", did_you_mean(name, known))
    if isinstance(node, MappingNode):
        return {name: _count(entry.value) for name, entry in node.entries.items()}
    return Counter(name for name, _ in named)


def _of_word(node: ScalarNode, given: Node | None) -> Delivery:
    if node.text == UNCHANGED:
        return _unchanged(node.span, given)
    if node.text == ANY:
        return Delivery(node.span)
    hint = f"write {UNCHANGED}, {ANY}, or {{CASE: {{FIELD: value}}}}"
    raise InvalidValueError(node.span, Code.BAD_VALUE, f"'{node.text}' is not a datagram", hint)


def _unchanged(span: SourceSpan, given: Node | None) -> Delivery:
    if not isinstance(given, MappingNode) or given.entries.keys() & _MESSAGES.keys():
        message = "'unchanged' needs a datagram that is given in this step"
        raise InvalidValueError(span, Code.BAD_VALUE, message, "write {ENDPOINT: {CASE: {FIELD: value}}}")
    return Delivery(span, is_unchanged=True)


def _bytes(node: Node) -> bytes:
    try:
        return bytes.fromhex(_name(node)[0])
    except ValueError:
        raise InvalidValueError(node.span, Code.BAD_VALUE, "'hex' takes bytes in quotes, such as '0a 05'") from None


def _times(node: MappingNode) -> int:
    times = node.get("times")
    return _count(times) if times else 1


def _count(node: Node) -> int:
    value = node.value if isinstance(node, ScalarNode) else None
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _MOST:
        raise InvalidValueError(node.span, Code.BAD_VALUE, f"this must be a whole number from 1 to {_MOST}")
    return value


def _refuse_repeated(named: Sequence[tuple[str, SourceSpan]]) -> None:
    names = [name for name, _ in named]
    for index, (name, span) in enumerate(named):
        if name in names[:index]:
            hint = f"if it gets the datagram twice, write {{{name}: {{times: 2}}}}"
            raise InvalidValueError(span, Code.BAD_VALUE, f"'{name}' is named twice", hint)


def _name(node: Node) -> tuple[str, SourceSpan]:
    if not isinstance(node, ScalarNode):
        raise InvalidValueError(node.span, Code.WRONG_TYPE, "this must be a name")
    return node.text, node.span


def _listed(node: Node | None) -> Sequence[Node]:
    """Return one node, or the items of a list; nothing for None."""
    if node is None:
        return ()
    return node.items if isinstance(node, SequenceNode) else (node,)


def _is(node: Node, word: str) -> bool:
    return isinstance(node, ScalarNode) and node.text == word
