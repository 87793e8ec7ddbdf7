"""Generate the code that writes a plan as CDR bytes, with as few `struct` calls as alignment allows.

`steps` makes a plan the flat sequence of what is written: scalars, known bytes, strings, lists. What comes before
the first string or list is one call with all offsets known. Behind it, offsets are known modulo 8 when the code
runs, and one of eight packers is taken.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Union

from router.compiler.cdr.constants import NO_FIELDS, known_default, known_length, known_value
from router.compiler.cdr.primitives import HEADER, scalar_format
from router.compiler.expressions.tree import Node, Variable
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.compiler.python import NO_VALUES, Values, lists_of, render
from router.compiler.source import Source, placed
from router.errors import SourceSpan
from router.types.model import List, String


@dataclass(frozen=True, slots=True)
class Put:
    """A scalar, which `node` computes. `format` is its struct letter, and gives its size and alignment."""

    format: str
    node: Node
    span: SourceSpan

    @property
    def size(self) -> int:
        return struct.calcsize(self.format)

    alignment = size


@dataclass(frozen=True, slots=True)
class Blob:
    """Bytes known at compile time, aligned as their first scalar."""

    data: bytes
    alignment: int

    @property
    def size(self) -> int:
        return len(self.data)


@dataclass(frozen=True, slots=True)
class Text:
    """A string known at run time; `wide` for a wstring."""

    node: Node
    wide: bool
    span: SourceSpan


@dataclass(frozen=True, slots=True)
class Repeat:
    """`body` once for each element of `lists`, which are taken side by side, with the variables of these elements."""

    type: List
    lists: tuple[tuple[str, Node], ...]
    body: tuple[Step, ...]
    span: SourceSpan


Step = Union[Put, Blob, Text, Repeat]


def steps(plan: Plan) -> Iterable[Step]:  # noqa: C901 - a case a plan
    """The steps that write a plan, in order."""
    match plan:
        case Record():
            for _, member in plan.members:
                yield from steps(member)
            if not plan.type.fields:
                yield Blob(*NO_FIELDS)
        case Unset():
            yield from (Blob(*known) for known in known_default(plan.type, plan.default))
        case Leaf() if plan.constant is not None:
            yield Blob(*known_value(plan.constant, plan.type))
        case Leaf(type=String(wide=wide)):
            yield Text(plan.node, wide, plan.span)
        case Leaf():
            yield Put(scalar_format(plan.type), plan.node, plan.span)
        case Items():
            if plan.type.length is None:
                yield Blob(*known_length(len(plan.items)))
            for item in plan.items:
                yield from steps(item)
        case Each():
            yield Repeat(plan.type, plan.lists, tuple(steps(plan.element)), plan.span)


def message_size(plan: Record) -> tuple[int, bool]:
    """The size of the CDR bytes with header, and whether it is exact; else strings and sequences count as empty."""
    size, exact = 0, True
    for step in steps(plan):
        match step:
            case Put() | Blob():
                size += -size % step.alignment + step.size
            case Text():
                size += -size % 4 + (4 if step.wide else 5)
                exact = False
            case Repeat():
                size += -size % 4 + 4 if step.type.length is None else 0
                exact = False
    return len(HEADER) + size, exact


@dataclass(frozen=True, slots=True)
class _Run:
    """Consecutive scalars and known bytes."""

    parts: tuple[Put | Blob, ...]

    def static(self, prefix: bytes) -> tuple[str, list[Put | bytes]]:
        """Struct format and arguments for a run at offset 0, behind `prefix`.

        Neighbouring known bytes and the padding between them become one argument.
        """
        letters, arguments, known, offset = ["<"], list[Union[Put, bytes]](), bytearray(prefix), 0
        for part in self.parts:
            padding = -offset % part.alignment
            known += bytes(padding)
            offset += padding + part.size
            if isinstance(part, Blob):
                known += part.data
                continue
            _add_known(bytes(known), letters, arguments)
            known.clear()
            letters.append(part.format)
            arguments.append(part)
        _add_known(bytes(known), letters, arguments)
        return "".join(letters), arguments

    def floating(self, phase: int) -> tuple[str, list[Put | bytes]]:
        """Struct format and arguments for a run at an offset of `phase` modulo 8; all phases have equal arguments."""
        letters, arguments, offset = ["<"], list[Union[Put, bytes]](), phase
        for part in self.parts:
            padding = -offset % part.alignment
            _add_known(bytes(padding), letters, arguments)
            offset += padding + part.size
            if isinstance(part, Blob):
                _add_known(part.data, letters, arguments)
            else:
                letters.append(part.format)
                arguments.append(part)
        return "".join(letters), arguments


def _add_known(data: bytes, letters: list[str], arguments: list[Put | bytes]) -> None:
    if any(data):
        letters.append(f"{len(data)}s")
        arguments.append(data)
    elif data:
        letters.append(f"{len(data)}x")  # zeros, which struct writes by itself


def write_message(out: Source, plan: Record, name: str, values: Values = NO_VALUES) -> str:
    """Append the code that makes the CDR bytes of a message, and return the expression that is the bytes.

    `name` is part of the names of packers and known bytes, and different for each message of a function. `values` are
    the fields that were read.
    """
    return _Writing(out, name, values).message(plan)


def _runs(sequence: Iterable[Step]) -> list[_Run | Text | Repeat]:
    """The steps with neighbouring scalars and known bytes joined into runs; never empty."""
    found: list[_Run | Text | Repeat] = []
    together: list[Put | Blob] = []
    for step in sequence:
        if isinstance(step, (Put, Blob)):
            together.append(step)
            continue
        if together:
            found.append(_Run(tuple(together)))
            together = []
        found.append(step)
    return [*found, _Run(tuple(together))] if together or not found else found


@dataclass(frozen=True, slots=True)
class _Writing:
    """Writes the statements for one message; see `write_message`."""

    out: Source
    name: str
    values: Values

    def message(self, plan: Record) -> str:
        runs = _runs(steps(plan))
        first = runs[0] if isinstance(runs[0], _Run) else _Run(())
        fixed = runs == [first]
        letters, arguments = first.static(HEADER if fixed else b"")
        pack = self.out.constant(f"pack_{self.name}", struct.Struct(letters).pack)
        self._call("data = {}" if fixed else "data = bytearray({})", pack, arguments, plan.span)
        if fixed:
            return "data"
        self._write(runs[1:] if runs[0] is first else runs, plan.span)
        return "HEADER + data"

    def _expression(self, node: Node) -> str:
        return self.out.expression(render(node, self.values))

    def _call(self, statement: str, function: str, arguments: Sequence[Put | bytes], span: SourceSpan) -> None:
        """Append a statement around a call, one argument a line."""
        before, _, after = statement.partition("{}")
        self.out.line(f"{before}{function}(", span)
        with self.out.indented():
            for argument in arguments:
                if isinstance(argument, bytes):
                    self.out.line(f"{self.out.constant(f'known_{self.name}', argument)},", span)
                else:
                    self.out.line(f"{self._expression(argument.node)},", argument.span)
        self.out.line(f"){after}", span)

    def _write(self, runs: Iterable[_Run | Text | Repeat], span: SourceSpan) -> None:
        """Append the code behind the first string or sequence, where offsets are known at run time, modulo 8."""
        for run in runs:
            match run:
                case _Run():
                    packers = tuple(struct.Struct(run.floating(phase)[0]).pack for phase in range(8))
                    at = self.out.constant(f"pack_{self.name}_at", packers)
                    self._call("data += {}", f"{at}[len(data) & 7]", run.floating(0)[1], span)
                case Text():
                    put = "put_wide_text" if run.wide else "put_text"
                    self.out.line(f"{put}(data, {self._expression(run.node)})", run.span)
                case Repeat():
                    self._repeat(run)

    def _repeat(self, repeat: Repeat) -> None:
        out = self.out
        names, iterated = lists_of(repeat.lists, self.values)
        out.line(f"values = {out.expression(placed(iterated, repeat.span))}", repeat.span)
        if repeat.type.length is not None:
            out.line(f"want_length(len(values), {repeat.type.length})", repeat.span)
        else:
            out.line(f"put_length(data, len(values), {repeat.type.bound})", repeat.span)
        if len(repeat.body) == 1 and isinstance(body := repeat.body[0], Put):
            plain = isinstance(body.node, Variable) and body.node.name == names
            each = "values" if plain else f"[{self._expression(body.node)} for {names} in values]"
            out.line(f"put_numbers(data, {body.format!r}, {body.size}, {each})", repeat.span)
            return
        with out.block(f"for {names} in values:", repeat.span):
            self._write(_runs(repeat.body), repeat.span)
