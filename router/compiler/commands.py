"""Messages from ROS that need no Python: from a checked topic to the operations that the carrier executes.

A topic is lowered if all that it feeds can be: one thread takes its messages. What can be lowered are fields of the
message, constants, `float32()`, `float64()` and `int()` of fields; all else stays in the generated handlers.
`native/convert.h` says what the operations do.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum, IntFlag
from typing import Any, NamedTuple

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message_factory import GetMessageClass

from router.compiler.cdr.reading import LENGTH, Leap, Loop, Moment, Object, Step, Stretch, Take, Unpack
from router.compiler.checked import CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.executors import CARRIER, Executor, Executors
from router.compiler.expressions.tree import Node as Typed
from router.compiler.namespace import NAMESPACE
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.compiler.source import call
from router.errors import MappingError, SourceSpan
from router.table.model import OnLimit, Route
from router.types.descriptors import message_of
from router.types.model import Bytes, Float, List, String, Type
from router.types.protobuf import PayloadCase
from router.types.wire import varint

MOST_SLOTS, MOST_REPEATS, MOST_OPEN = 1024, 8, 32
"""As in `native/convert.h`."""

NO_SLOT = 0xFFFF
_ANY = 0xFFFF_FFFF


class ReadKind(IntEnum):
    SCALARS = 0
    SEQUENCE = 1
    REPEAT = 2
    REPEAT_SEQUENCE = 3
    AGAIN = 4


class WriteKind(IntEnum):
    LITERAL = 0
    SCALAR = 1
    LIST = 2
    TEXT = 3
    BYTES = 4
    END = 5
    BEGIN = 6


class Encoding(IntEnum):
    VARINT = 0
    ZIGZAG = 1
    FIXED32 = 2
    FIXED64 = 3
    FLOAT = 4
    DOUBLE = 5


class Flag(IntFlag):
    DEFAULT = 1
    PACKED = 2
    FLOAT32 = 4


class ReadOp(NamedTuple):
    """`struct read_op`."""

    kind: ReadKind
    size: int = 1
    slot: int = NO_SLOT
    elements: int = 1


class WriteOp(NamedTuple):
    """`struct write_op`, with the bytes of a literal."""

    kind: WriteKind
    scalar: int = 0
    encoding: Encoding = Encoding.VARINT
    flags: Flag = Flag(0)
    slot: int = 0
    tag: int = 0
    least: int = 0
    most: int = _ANY
    literal: bytes = b""


@dataclass(frozen=True, slots=True)
class CommandTarget:
    """What makes the datagram of one destination, in the order of execution: from its end."""

    label: str
    writes: tuple[WriteOp, ...]


@dataclass(frozen=True, slots=True)
class Command:
    """One route from one topic. `stamp` are the slots of seconds and nanoseconds of the message's stamp, or None.

    It is urgent if it has a `ttl`, or feeds or disarms a deadman.
    """

    route: str
    is_urgent: bool
    reads: tuple[ReadOp, ...]
    targets: tuple[CommandTarget, ...]
    stamp: tuple[int, int] | None


Commands = Mapping[str, tuple[Command, ...]]
"""By topic: what each route makes of its messages, in the order of the table."""


@dataclass(frozen=True, slots=True)
class LoweredCommands:
    """What routes from ROS take. `commands` are the topics that the carrier takes, `executors` those of all."""

    commands: Commands
    executors: Executors


class NeedsPythonError(Exception):
    """Why a topic cannot be lowered, and where the table says so."""

    def __init__(self, reason: str, span: SourceSpan) -> None:
        super().__init__(reason)
        self.span = span


def lower_commands(routes: Sequence[CheckedRoute]) -> LoweredCommands:
    """Lower what can be lowered of a table without errors."""
    topics: dict[str, list[tuple[CheckedRoute, CheckedSubscription]]] = {}
    for checked in routes:
        for feed in checked.subscriptions:
            topics.setdefault(feed.topic.topic.value, []).append((checked, feed))
    commands: dict[str, tuple[Command, ...]] = {}
    executors: dict[tuple[str, str | None, str | None], Executor] = {}
    for topic, feeds in topics.items():
        executor = CARRIER
        try:
            commands[topic] = tuple(lower(checked.route, checked.case, feed) for checked, feed in feeds)
        except NeedsPythonError as error:
            is_urgent = any(_is_urgent(checked.route, feed) for checked, feed in feeds)
            executor = Executor(f"{error}; its freshness is Python's" if is_urgent else str(error), error.span)
        for checked, feed in feeds:
            executors |= {(checked.route.name, topic, target.label): executor for target in feed.targets}
    return LoweredCommands(commands, executors)


def _is_urgent(route: Route, feed: CheckedSubscription) -> bool:
    return route.ttl is not None or any(target.deadmen for target in feed.targets)


def lower(route: Route, case: PayloadCase, feed: CheckedSubscription) -> Command:
    """Lower what a route makes of the messages of one topic. Raises NeedsPythonError."""
    raise NeedsPythonError("typed trees are not lowered yet", feed.topic.span)
    if feed.for_each is not None:
        raise NeedsPythonError("`for_each` needs it", feed.for_each.span)
    if feed.when is not None:
        raise NeedsPythonError(f"`when: {feed.topic.when}` needs it", feed.when.span)
    for target in feed.targets:
        _want_immediate(target)
    reading = _Reading(feed.topic.span)
    reading.add(feed.reads.steps())
    targets = tuple(_target(case, target, reading.found) for target in feed.targets)
    is_urgent = _is_urgent(route, feed)
    return Command(route.name, is_urgent, tuple(reading.ops), targets, _stamp(feed.stamp, reading))


def _want_immediate(target: CheckedTarget) -> None:
    """Raise NeedsPythonError for a target with a condition, and one that may be served later."""
    if target.when is not None:
        raise NeedsPythonError(f"`when: {target.declared.when}` needs it", target.when.span)
    if target.declared.on_limit is OnLimit.LATEST:
        raise NeedsPythonError("`on_limit: latest` needs it", target.span)
    if target.endpoint is not None and target.endpoint.bandwidth is not None:
        raise NeedsPythonError(f"the bandwidth of '{target.label}' needs it", target.endpoint.span)


def _stamp(stamp: Typed | None, reading: _Reading) -> tuple[int, int] | None:
    if stamp is None:
        return None
    assert isinstance(stamp.node, ast.Name)  # noqa: S101 - a field of the message
    return reading.moments[stamp.node.id]


# ---- reading

_SCALARS = "?bBhHiIqQfd"
"""Formats of `struct`, in the order of `enum scalar`."""

_OCTET = _SCALARS.index("B")


@dataclass(frozen=True, slots=True)
class _Found:
    """The slot of a variable of the generated handler. `is_list` is said of strings as well."""

    slot: int
    scalar: int
    is_list: bool


@dataclass(slots=True)
class _Reading:
    """Makes the first program. `found` are the variables that it reads; others are no scalars, strings or lists."""

    span: SourceSpan
    ops: list[ReadOp] = field(default_factory=list)
    found: dict[str, _Found] = field(default_factory=dict)
    moments: dict[str, tuple[int, int]] = field(default_factory=dict)
    _depth: int = 0

    def add(self, steps: Iterable[Step]) -> None:
        for step in steps:
            match step:
                case Take() if step is LENGTH:
                    pass  # it stands before a step that reads it
                case Take():
                    self._take(step)
                case Stretch():
                    slot = self._slot(step.variable, _SCALARS.index(step.letter or "B"), is_list=True)
                    self.ops.append(ReadOp(ReadKind.SEQUENCE, step.size, slot))
                case Loop() | Leap():
                    self._repeat(step)
                case Unpack():
                    earlier = self.found[step.variable]
                    self.found[step.variable] = _Found(earlier.slot, _SCALARS.index(step.letter), is_list=True)
                case Moment():
                    seconds, nanoseconds = self.found[step.seconds], self.found[step.nanoseconds]
                    self.moments[step.variable] = seconds.slot, nanoseconds.slot
                case Object():
                    pass  # what uses it needs Python

    def _take(self, step: Take) -> None:
        """A scalar, or the bytes of an array: its elements are as large as its alignment."""
        is_list = step.format.endswith("s")
        scalar = _OCTET if is_list else _SCALARS.index(step.format)
        slot = self._slot(step.variable, scalar, is_list=is_list)
        self.ops.append(ReadOp(ReadKind.SCALARS, step.alignment, slot, step.size // step.alignment))

    def _repeat(self, step: Loop | Leap) -> None:
        """Step over a list of messages or strings: what is in it has no slots."""
        self._depth += 1
        if self._depth > MOST_REPEATS:
            raise NeedsPythonError("its message has lists within too many lists", self.span)
        count = step.count if isinstance(step, Loop) else None
        kind = ReadKind.REPEAT_SEQUENCE if count is None else ReadKind.REPEAT
        self.ops.append(ReadOp(kind, elements=count or 0))
        self.add(_unwanted(step.body if isinstance(step, Loop) else step.element))
        self.ops.append(ReadOp(ReadKind.AGAIN))
        self._depth -= 1

    def _slot(self, variable: str | None, scalar: int, *, is_list: bool) -> int:
        if variable is None:
            return NO_SLOT
        slot = len(self.found)
        if slot == MOST_SLOTS:
            raise NeedsPythonError(f"it reads more than {MOST_SLOTS} fields", self.span)
        self.found[variable] = _Found(slot, scalar, is_list)
        return slot


def _unwanted(steps: Iterable[Step]) -> Iterator[Step]:
    for step in steps:
        match step:
            case Take() if step is LENGTH:
                yield step
            case Take() | Stretch():
                yield replace(step, variable=None)
            case Loop() | Leap():
                yield step


# ---- writing

_ENCODINGS: Mapping[int, Encoding] = {
    FieldDescriptor.TYPE_SINT32: Encoding.ZIGZAG,
    FieldDescriptor.TYPE_SINT64: Encoding.ZIGZAG,
    FieldDescriptor.TYPE_FIXED32: Encoding.FIXED32,
    FieldDescriptor.TYPE_SFIXED32: Encoding.FIXED32,
    FieldDescriptor.TYPE_FIXED64: Encoding.FIXED64,
    FieldDescriptor.TYPE_SFIXED64: Encoding.FIXED64,
    FieldDescriptor.TYPE_FLOAT: Encoding.FLOAT,
    FieldDescriptor.TYPE_DOUBLE: Encoding.DOUBLE,
}
"""By type of a field; all others are varints."""

_WIRE_TYPES = {Encoding.FIXED32: 5, Encoding.FLOAT: 5, Encoding.FIXED64: 1, Encoding.DOUBLE: 1}
_VARINT, _LEN = 0, 2


def _target(case: PayloadCase, target: CheckedTarget, found: Mapping[str, _Found]) -> CommandTarget:
    assert target.plan is not None  # noqa: S101 - a message of ROS is mapped
    descriptor: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # of upb
    rows = {row.target: row.expression for row in target.rows}
    writer = _Writing(found, rows)
    ops = list(writer.delimited(case.number << 3 | _LEN, writer.record(target.plan, descriptor, ()), 0))
    if writer.deepest >= MOST_OPEN:
        raise NeedsPythonError("its payload has messages within too many messages", target.span)
    return CommandTarget(target.label, tuple(_merged(reversed(ops))))


def _merged(ops: Iterator[WriteOp]) -> Iterator[WriteOp]:
    """Adjacent literals as one, without empty ones. The later of two stands in front."""
    literal = b""
    for op in ops:
        if op.kind is WriteKind.LITERAL:
            literal = op.literal + literal
            continue
        if literal:
            yield WriteOp(WriteKind.LITERAL, literal=literal)
            literal = b""
        yield op
    if literal:
        yield WriteOp(WriteKind.LITERAL, literal=literal)


@dataclass(slots=True)
class _Writing:
    """Makes the second program, in the order of the bytes. `rows` are the expressions by path of their field."""

    found: Mapping[str, _Found]
    rows: Mapping[str, str]
    deepest: int = 0

    def delimited(self, tag: int, inside: Iterator[WriteOp], depth: int) -> Iterator[WriteOp]:
        self.deepest = max(self.deepest, depth)
        yield WriteOp(WriteKind.BEGIN, tag=tag)
        yield from inside
        yield WriteOp(WriteKind.END)

    def record(self, plan: Record, descriptor: Descriptor, path: tuple[str, ...]) -> Iterator[WriteOp]:
        for member, made in sorted(plan.members, key=lambda each: each[0].number):
            yield from self._member(made, descriptor.fields_by_name[member.name], (*path, member.name))

    def _member(self, made: Plan, to: FieldDescriptor, path: tuple[str, ...]) -> Iterator[WriteOp]:
        match made:
            case Leaf():
                flags = Flag.DEFAULT if to.has_presence else Flag(0)
                yield self._leaf(made, to, path, flags, _tag(to))
            case Record():
                yield from self._message(made, to, path)
            case Items():
                yield from self._items(made, to, path)
            case Each():
                yield self._each(made, to, path)
            case Unset():
                pass

    def _message(self, made: Record, to: FieldDescriptor, path: tuple[str, ...]) -> Iterator[WriteOp]:
        if to.type == FieldDescriptor.TYPE_GROUP or made.type.is_map_entry:
            raise self._needs_python(made.span, path)
        yield from self.delimited(_tag(to), self.record(made, message_of(to), path), len(path))

    def _items(self, made: Items, to: FieldDescriptor, path: tuple[str, ...]) -> Iterator[WriteOp]:
        if made.items and to.is_packed:
            yield from self.delimited(to.number << 3 | _LEN, self._packed(made, to, path), len(path))
            return
        for element in made.items:
            if isinstance(element, Leaf):
                yield self._leaf(element, to, path, Flag.DEFAULT, _tag(to))
            elif isinstance(element, Record):
                yield from self._message(element, to, path)

    def _packed(self, made: Items, to: FieldDescriptor, path: tuple[str, ...]) -> Iterator[WriteOp]:
        for element in made.items:
            assert isinstance(element, Leaf)  # noqa: S101 - only scalars are packed
            yield self._leaf(element, to, path, Flag.DEFAULT, 0)

    def _each(self, made: Each, to: FieldDescriptor, path: tuple[str, ...]) -> WriteOp:
        """A repeated scalar, element by element from a list of the message."""
        source = self.found.get(made.values.id) if isinstance(made.values, ast.Name) else None
        element = made.element
        is_copied = isinstance(element, Leaf) and _name(element.node) == made.variable
        if source is None or not is_copied or not _is_open_scalar(to):
            raise self._needs_python(made.span, path)
        least, most = _limits(made.type)
        flags = Flag.PACKED if to.is_packed else Flag(0)
        encoding = _ENCODINGS.get(to.type, Encoding.VARINT)
        tag = to.number << 3 | _LEN if to.is_packed else _tag(to)
        return WriteOp(WriteKind.LIST, source.scalar, encoding, flags, source.slot, tag, least, most)

    def _leaf(self, leaf: Leaf, to: FieldDescriptor, path: tuple[str, ...], flags: Flag, tag: int) -> WriteOp:
        if _is_constant(leaf.node):
            literal = self._literal(leaf, to, path)
            return WriteOp(WriteKind.LITERAL, literal=literal if tag else _without_head(literal, to))
        op = self._text(leaf) or self._scalar(leaf, to)
        if op is None:
            raise self._needs_python(leaf.span, path)
        return op._replace(flags=op.flags | flags, tag=tag)

    def _scalar(self, leaf: Leaf, to: FieldDescriptor) -> WriteOp | None:
        node, flags = leaf.node, Flag(0)
        while isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1:
            if node.func.id == "float32":
                flags |= Flag.FLOAT32
            elif node.func.id not in ("float64", "int"):
                return None
            node = node.args[0]
        source = self.found.get(_name(node) or "")
        if source is None or source.is_list or not _is_open_scalar(to):
            return None
        encoding = _ENCODINGS.get(to.type, Encoding.VARINT)
        return WriteOp(WriteKind.SCALAR, source.scalar, encoding, flags, source.slot)

    def _text(self, leaf: Leaf) -> WriteOp | None:
        """A string or bytes, of limited length or not."""
        node, most = leaf.node, _ANY
        match node:
            case ast.Call(ast.Name("fit_text"), [inner, ast.Constant(int(bound))]):
                node, most = inner, bound
        match node, leaf.type:
            case (ast.Call(ast.Name("text"), [ast.Name(name)]), String()):
                kind = WriteKind.TEXT
            case (ast.Call(ast.Name("bytes"), [ast.Name(name)]), Bytes()):
                kind = WriteKind.BYTES
            case _:
                return None
        source = self.found.get(name)
        return WriteOp(kind, slot=source.slot, most=most) if source else None

    def _literal(self, leaf: Leaf, to: FieldDescriptor, path: tuple[str, ...]) -> bytes:
        """The bytes of a field, with its tag, that a constant fills: none for a default without presence."""
        holder: Any = GetMessageClass(to.containing_type)()  # type: ignore[arg-type]  # it has one
        try:
            value = eval(compile(_expression(leaf), "<constant>", "eval"), dict(NAMESPACE))  # noqa: S307 - ours
            if to.is_repeated:
                getattr(holder, to.name).append(value)
            else:
                setattr(holder, to.name, value)
        except (MappingError, ArithmeticError, ValueError, LookupError):
            raise self._needs_python(leaf.span, path) from None
        encoded: bytes = holder.SerializePartialToString()
        return encoded

    def _needs_python(self, span: SourceSpan, path: tuple[str, ...]) -> NeedsPythonError:
        """The expression is that of the field, or of the message around it that has one."""
        names = [".".join(path[:length]) for length in range(len(path), 0, -1)]
        shown = next((f"{name}: {self.rows[name]}" for name in names if name in self.rows), names[0])
        return NeedsPythonError(f"`{shown}` needs it", span)


def _tag(to: FieldDescriptor) -> int:
    if to.type in (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES, FieldDescriptor.TYPE_MESSAGE):
        return to.number << 3 | _LEN
    return to.number << 3 | _WIRE_TYPES.get(_ENCODINGS.get(to.type, Encoding.VARINT), _VARINT)


def _without_head(packed: bytes, to: FieldDescriptor) -> bytes:
    """A packed scalar without its tag and its length, which has one byte."""
    return packed[len(varint(to.number << 3 | _LEN)) + 1 :]


def _is_open_scalar(to: FieldDescriptor) -> bool:
    """Whether the field is a number or a bool. A closed enum refuses numbers, which protobuf has to decide."""
    if to.enum_type is not None:
        return not to.enum_type.is_closed
    texts = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
    return to.message_type is None and to.type not in texts


def _limits(declared: Type) -> tuple[int, int]:
    assert isinstance(declared, List)  # noqa: S101 - an Each fills one
    if declared.length is not None:
        return declared.length, declared.length
    return 0, declared.bound if declared.bound is not None else _ANY


def _name(node: ast.expr) -> str | None:
    return node.id if isinstance(node, ast.Name) else None


def _is_constant(node: ast.expr) -> bool:
    """Whether an expression reads nothing: all its names are those of functions."""
    names = (inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name))
    return all(name in NAMESPACE or name == "bytes" for name in names)


def _expression(leaf: Leaf) -> ast.Expression:
    """With the check that the generated handlers make where a number becomes a float32."""
    node = call("float32", leaf.node) if leaf.type == Float(32) else leaf.node
    return ast.fix_missing_locations(ast.Expression(node))
