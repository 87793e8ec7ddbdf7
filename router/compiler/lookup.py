"""Looks up the names in a table: `.proto` folders, ROS interfaces, endpoints and payload cases."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from router import inputs
from router.compiler.compiled_table import Beside
from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.kinds import BoolKind, Kind
from router.compiler.expressions.operators import presence_hint
from router.compiler.expressions.scope import BrokenStateError
from router.compiler.expressions.tree import Node
from router.compiler.network_findings import loop_finding
from router.errors import Code, Diagnostic, Located, SourceSpan, TableError, did_you_mean, nearest, one_of
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint
from router.table.model.expressions import Expression
from router.table.model.routes import ANY, ROS, Route
from router.table.model.settings import EnvelopeSettings
from router.table.model.targets import Topic
from router.types.board_limits import BoardLimits
from router.types.boards import board_findings
from router.types.model import List, MessageType, Type
from router.types.protobuf import PayloadCase, ProtoSchema, load_protos, lock_path
from router.types.ros import RosInterfaces, definition, ros_interfaces
from router.types.table_envelopes import Envelopes


class Definitions:
    """Protos and ROS interfaces, read once for several tables.

    `known` are protos that were read before; they are reused if their files are unchanged.
    """

    def __init__(self, known: Iterable[ProtoSchema] = ()) -> None:
        self._protos: dict[tuple[Path, str, Path, tuple[str, ...], bool], ProtoSchema] = {}
        self._known = tuple(known)

    def protos(self, settings: EnvelopeSettings) -> ProtoSchema:
        """Return the protos of an envelope. Raises TableError; an invalid folder is read again for each table."""
        exclude = tuple(entry.value for entry in settings.exclude)
        lock = lock_path(settings.protos, settings.lock_file)
        key = settings.protos.value, settings.message.value, lock, exclude, settings.has_many
        if key not in self._protos:
            known = self._unchanged(settings)
            self._protos[key] = known or load_protos(
                settings.protos, settings.message, settings.lock_file, settings.exclude, with_others=settings.has_many
            )
        return self._protos[key]

    def _unchanged(self, settings: EnvelopeSettings) -> ProtoSchema | None:
        root, lock = Path(inputs.real_path(settings.protos.value)), lock_path(settings.protos, settings.lock_file)
        exclude = [entry.value for entry in settings.exclude]
        wanted = root, lock, exclude, settings.has_many
        for known in self._known:
            is_same = (known.root, known.lock, known.exclude, known.with_others) == wanted
            if is_same and settings.message.value in (known.envelope, known.envelope.rpartition(".")[2]):
                return known if known.inputs.read_again() else None
        return None

    @cached_property
    def interfaces(self) -> RosInterfaces:
        return ros_interfaces()


_ALIKE = 0.8
"""Similarity required to suggest another endpoint. It is high, because commands go there."""
NO_NAMES: Mapping[str, Node] = {}


class Recipient(NamedTuple):
    """An endpoint, and the payload case as which it gets a payload: with several envelopes, one of its own envelope."""

    endpoint: Endpoint
    case: PayloadCase


@dataclass
class Lookup:
    """Looks up the names of one table and collects findings.

    `boards` has the limits of each board by endpoint, `beside` what `set` of an endpoint fills, `states` the kind of
    each state, None for one with a finding.
    """

    table: RouteTable
    envelopes: Envelopes
    definitions: Definitions
    boards: Mapping[str, BoardLimits]
    findings: list[Diagnostic] = field(default_factory=list)
    beside: Mapping[str, Beside] = field(default_factory=dict)
    states: dict[str, Kind | None] = field(default_factory=dict)

    def report(self, span: SourceSpan, code: Code, message: str, hint: str = "") -> None:
        self.findings.append(Diagnostic(span, code, message, hint))

    @cached_property
    def disarmed(self) -> Mapping[str, Sequence[Route]]:
        """The routes whose deadman names a payload case or a route in `disarmed_by`, by that name."""
        by_name: dict[str, list[Route]] = {}
        for route in self.table.routes:
            for name in {name.value for name in (route.deadman and route.deadman.disarmed_by) or ()}:
                by_name.setdefault(name, []).append(route)
        return by_name

    @cached_property
    def routes(self) -> Mapping[str, Route]:
        return {route.name: route for route in self.table.routes}

    def case(self, name: Located[str]) -> PayloadCase | None:
        case = self.envelopes.cases.get(name.value)
        if (other := self.envelopes.unroutable.get(name.value)) is not None:
            message = f"no route can take '{name.value}': it is {other.type}, not a message"
            hint = "wrap it in a message of its own, or ignore it with `ignore: reason`"
            self.report(name.span, Code.BAD_PROTO, message, hint)
        elif case is None:
            message, hint = self.envelopes.unknown_case(name.value)
            self.report(name.span, Code.UNKNOWN_PAYLOAD_CASE, message, hint)
        return case

    def endpoint(self, name: Located[str], also: Iterable[str] = ()) -> Endpoint | None:
        """Return the endpoint. If there is none, return None and report that, unless its declaration has a finding.

        `also` are other valid names.
        """
        endpoint = self.table.endpoints.get(name.value)
        if endpoint is None and f"endpoints/{name.value}" not in self.table.broken:
            known = [*self.table.endpoints, *also]
            hint = _endpoint_hint(name.value, known, is_source=bool(also))
            self.report(name.span, Code.UNKNOWN_ENDPOINT, f"there is no endpoint '{name.value}'", hint)
        return endpoint

    def recipient(self, case: PayloadCase, name: Located[str], sources: AbstractSet[str]) -> Recipient | None:
        """Return the endpoint `name`, a recipient of payloads of `case` from `sources`; None with a finding."""
        endpoint = self.endpoint(name)
        if endpoint is None or (held := self._held(case, endpoint, name.span)) is None:
            return None
        finding = loop_finding(self.table, endpoint, name.span, case.name, sources)
        if finding and finding.message not in {earlier.message for earlier in self.findings}:
            self.findings.append(finding)  # an endpoint that is the router itself is reported once, not per route
        if (limits := self.boards.get(endpoint.name)) is not None:
            self.findings += board_findings(held, self.envelopes.of(held.name).schema, limits.longest, name.span)
        return Recipient(endpoint, held)

    def _held(self, case: PayloadCase, endpoint: Endpoint, span: SourceSpan) -> PayloadCase | None:
        """Return the payload case as which an endpoint gets payloads of `case`; None with a finding."""
        if self.envelopes.endpoints[endpoint.name] not in self.envelopes.by_name:
            return case  # its envelope has a finding already
        found, around = self.envelopes.held(case, endpoint.name), self.envelopes.to(endpoint.name)
        if len(found) == 1:
            return found[0]
        several = f"several payload cases of type {case.type.name}: {', '.join(each.name for each in found)}"
        what = several if found else f"no payload case of type {case.type.name}"
        hint = "publish the message on a topic, and write a route from that topic to the endpoint"
        self.report(span, Code.BAD_VALUE, f"'{endpoint.name}' gets {around.name}, which has {what}", hint)
        return None

    def require_listener(self, case: PayloadCase, source: Located[str]) -> None:
        """Report a source whose datagrams arrive only at listeners that receive other envelopes."""
        envelopes, endpoint = self.envelopes, self.table.endpoints.get(source.value)
        names = [endpoint.listener.value] if endpoint and endpoint.listener else [*self.table.listeners]
        wanted = {envelopes.of(case.name).label}
        received = {envelopes.listeners[name] for name in names if name in envelopes.listeners}
        if not received or received & wanted or not received <= envelopes.by_name.keys():
            return
        others = " and ".join(f"'{name}'" for name in sorted(received))
        places = f"listener '{names[0]}'" if len(names) == 1 else "the listeners"
        verb = "receives" if len(names) == 1 else "receive"
        message = f"'{case.name}' cannot arrive from '{source.value}': {places} {verb} only {others}"
        hint = f"add a listener with `envelope: {envelopes.of(case.name).label}`"
        self.report(source.span, Code.BAD_VALUE, message, hint)

    def ros_type(self, topic: Topic) -> MessageType | None:
        """Return the message type of a topic, or None with a finding; without a finding if the topic has no `type`."""
        if topic.type is None:
            return None
        name = topic.type.value
        try:
            ros_type = self.definitions.interfaces.get(name)
        except TableError as error:
            self.findings += error.diagnostics
            return None
        if ros_type is None:
            is_default = topic.type.span == topic.topic.span
            self._report_type(topic.type, self.table.package if is_default else None)
        return ros_type

    def _report_type(self, name: Located[str], package: Located[str] | None) -> None:
        """Report an unknown type. `package` is the default package if the type was made from it."""
        known = self.definitions.interfaces.names()
        packages = {full.partition("/")[0] for full in known}
        if package is not None and package.value not in packages:
            near = nearest(package.value, packages, _SAME_PACKAGE)
            hint = f"did you mean '{near}'?" if near else _SOURCE.format(package.value)
            message = f"there is no package '{package.value}' with ROS messages"
            self.report(package.span, Code.UNKNOWN_ROS_TYPE, message, hint)
            return
        if other := _OTHER_INTERFACES.fullmatch(name.value):
            what = f"'{name.value}' is {'a service' if other['kind'] == 'srv' else 'an action'}, not a message"
            instead = "a service belongs in `services`" if other["kind"] == "srv" else "actions are not routed"
            hint = f"topics have message types, such as std_msgs/msg/Bool; {instead}"
            self.report(name.span, Code.UNKNOWN_ROS_TYPE, what, hint)
            return
        hint = _ros_type_hint(name.value, known)
        if package is not None:
            hint = f"the type is made from `defaults.package`; set the topic's 'type' ({hint})"
        self.report(name.span, Code.UNKNOWN_ROS_TYPE, f"there is no ROS message type '{name.value}'", hint)

    def scope(
        self,
        message: MessageType,
        ros_type: MessageType | None = None,
        names: Mapping[str, Node] = NO_NAMES,
    ) -> Scope:
        """Return the scope of expressions over `message`, with the constants of `ros_type` and of the types in it."""
        nested = tuple(nested_types(ros_type)) if ros_type else ()
        return Scope(message, self.envelopes.enums, nested, names, states=self.states)

    def received(
        self,
        case: PayloadCase,
        ros_type: MessageType | None = None,
        names: Mapping[str, Node] = NO_NAMES,
        route: Route | None = None,
    ) -> Scope:
        """Return the scope of expressions over a payload from UDP and its envelope. A `route` names its sources."""
        sources = tuple(source.value for source in route.sources) if route else ()
        known = () if ANY in sources else sources
        return replace(self.scope(case.type, ros_type, names), envelope=self.envelopes.of(case.name), sources=known)

    def value(
        self,
        expression: Expression,
        scope: Scope,
        kinds: tuple[type[Kind], ...],
        wanted: str,
        hint: str = "",
        expected: Type | None = None,
    ) -> Node | None:
        """Check that an expression is of one of `kinds`. If not, return None and report `wanted`.

        `expected` is as in `expressions.check`.
        """
        try:
            node = check(expression, scope, expected)
            if not isinstance(node.kind, kinds):
                hint = (presence_hint(node) if BoolKind in kinds else "") or hint
                raise ExpressionError(node.span, Code.TYPE_MISMATCH, f"{wanted}, not {node.kind}", hint)
        except BrokenStateError:
            return None
        except ExpressionError as error:
            self.findings.append(error.diagnostic)
            return None
        return node

    def when(self, expression: Expression | None, scope: Scope) -> Node | None:
        if expression is None:
            return None
        hint = "write a comparison, such as fix_quality != GPSFixQuality.NO_FIX"
        return self.value(expression, replace(scope, reads_states=True), (BoolKind,), "'when' takes a bool", hint)


def _endpoint_hint(name: str, known: Collection[str], *, is_source: bool) -> str:
    """Return a hint for an endpoint that does not exist."""
    if "," in name:
        names = [part.strip() for part in name.split(",") if part.strip()]
        return f"write a list: [{', '.join(names)}]" if len(names) > 1 else "remove the ','"
    if is_source and name == "*":
        return f"did you mean '{ANY}'?"
    if is_source and name == ROS:
        return "write a topic as `source: {topic: NAME}`"
    if not is_source and name.startswith("/"):
        return f"write a topic as a key of the route: `topic: {name}`"
    is_topic = is_source and not nearest(name, known, _ALIKE)
    topic = f"; write a topic as `source: {{topic: {name}}}`" if is_topic else ""
    return did_you_mean(name, known, _ALIKE) + topic


def nested_types(declared: Type) -> Iterable[MessageType]:
    """Return a ROS message type and all message types in it, each once."""
    by_name: dict[str, MessageType] = {}
    waiting: list[Type] = [declared]
    while waiting:
        current = waiting.pop()
        if isinstance(current, List):
            waiting.append(current.element)
        elif isinstance(current, MessageType) and current.name not in by_name:
            by_name[current.name] = current
            waiting += [member.type for member in current.fields]
    return by_name.values()


def definitions_of(message: MessageType) -> dict[str, tuple[tuple[str, str], ...]]:
    """Return the fields of a type and of each type in it as rclpy spells them, which determine the layout of CDR."""
    return {nested.name: definition(nested) for nested in nested_types(message)}


def _ros_type_hint(name: str, known: Collection[str]) -> str:
    """Return a hint: types of that name in any package, else types of its package, else where types come from."""
    parts = [part for part in re.split(r"[/:.]+", name) if part] or [name]
    package, short = parts[0], parts[-1]
    if (exact := f"{package}/msg/{short}") in known:
        return f"did you mean '{exact}'?"
    namesakes = sorted(full for full in known if full.rpartition("/")[2] == short)
    siblings = [full for full in known if full.partition("/")[0] == package]
    source = Path("schemas", package, "msg", f"{short}.msg")
    if inputs.is_file(source):  # an installation only uses built and sourced packages
        return f"it is in {source.parent}, but not built: build and source {package}"
    if siblings or len(parts) == 1:
        general = "neither schemas/ nor an installed package defines it; write types like sensor_msgs/msg/Imu"
        return one_of(namesakes) or did_you_mean(name, siblings) or general
    near = nearest(package, {full.partition("/")[0] for full in known}, _SAME_PACKAGE)
    if near:
        return did_you_mean(f"{near}/msg/{short}", [full for full in known if full.partition("/")[0] == near])
    other = one_of(namesakes)
    return f"{_SOURCE.format(package)}{'; or ' * bool(other)}{other}"


_OTHER_INTERFACES = re.compile(r"\w+/(?P<kind>srv|action)/\w+")
"""Types of services and actions."""
_SAME_PACKAGE = 0.85
"""Similarity required of a misspelt package name: `my_interfaces` is not `rcl_interfaces`."""
_SOURCE = "build '{}' and source its workspace (`source install/setup.bash`)"
