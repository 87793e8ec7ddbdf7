"""Random programs for the machine in C, as a compiler of well-typed expressions makes them.

Each has a layout of random fields, a condition, and a message in CDR or protobuf. Every operation comes up.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

from router.declared import NONE
from tests.carrier.evaluating import (
    CDR_HEADER,
    C,
    Layout,
    Operation,
    Section,
    Step,
    WantedField,
    integer,
    load,
    real,
    text,
)

INTEGER, REAL, TRUTH, TEXT = "integer", "real", "truth", "text"
IN_CELLS = C["IN_CELLS"]
RECEIVED_AT, SOURCE, FIRST_OF_FIELDS = 0, 1, 2
MOST_SLOTS = 200

Code = list[Operation]

_SCALARS = ["BOOL", "INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64", "FLOAT32", "FLOAT64"]
_SIZES = dict(zip(_SCALARS, (1, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8), strict=True))
_PROTOBUF_SCALARS = ["BOOL", "INT32", "INT64", "UINT32", "SINT32", "SINT64", "FIXED32", "SFIXED32", "FIXED64", "FLOAT",
                     "DOUBLE", "BYTES", "CLOSED_ENUM"]  # fmt: skip
_INTEGERS = [0, 1, 2, 3, -1, -7, 100, 255, -(1 << 63), (1 << 63) - 1, (1 << 64) - 1, 1 << 53]
_REALS = [0.0, -0.0, 0.5, 1.5, -2.5, 1e300, -1e-300, 3.5e38, 9.3e18, math.inf, -math.inf, math.nan]
_TEXTS = [b"", b"a", "ä€".encode(), b"text\0with", b"\xff", b"x" * 40]


@dataclass(frozen=True)
class Listed:
    """A list in a slot: of what, how it is stored, and the section of its elements if these are messages."""

    slot: int
    element: str
    stored: int = IN_CELLS
    section: int = NONE


@dataclass
class Fields:
    """What a section has in its slots."""

    values: list[tuple[int, str]] = field(default_factory=list)
    lists: list[Listed] = field(default_factory=list)

    def of(self, kind: str) -> list[int]:
        return [slot for slot, of in self.values if of == kind]


@dataclass(frozen=True)
class ForEach:
    """A program that leaves a list, how this is stored, and where an element goes: NONE for the other one."""

    code: Code
    stored: int
    section: int
    item: int


@dataclass(frozen=True)
class Program:
    layout: Layout
    condition: Code
    message: Code
    for_each: ForEach | None = None


class _Layouts:
    """Makes a layout, and remembers what its slots hold."""

    def __init__(self, noise: random.Random, *, is_cdr: bool) -> None:
        self.noise, self.is_cdr = noise, is_cdr
        self.sections: list[Section | None] = []
        self.fields: list[Fields] = []
        self.slots = FIRST_OF_FIELDS
        self.section(0)
        self.layout = Layout(
            sections=[section for section in self.sections if section],
            slot_count=MOST_SLOTS,
            is_cdr=is_cdr,
            closed=([-5, 0, 1, 7],),
        )

    def slot(self) -> int:
        self.slots += 1
        return self.slots - 1

    def section(self, depth: int, into: Fields | None = None) -> int:
        """A new section; `into` are the fields of the message that it is a part of, if it is no element."""
        index, first = len(self.sections), self.slots
        self.sections.append(None)
        self.fields.append(into or Fields())
        reads = self._steps(index, depth) if self.is_cdr else self._wanted_fields(index, depth)
        self.sections[index] = Section(reads, first_slot=first, slot_count=self.slots - first)
        return index

    # protobuf

    def _wanted_fields(self, index: int, depth: int) -> list[WantedField]:
        noise, fields, made = self.noise, self.fields[index], []
        of_one = noise.random() < 0.5
        choice = self.slot() if of_one else NONE
        if of_one:
            fields.values.append((choice, INTEGER))
        cleared = self.slots
        members = noise.randint(1, 3) if of_one else 0
        numbers = sorted(noise.sample([*range(1, 20), 100, 3000], noise.randint(members, 6)))
        for position, number in enumerate(numbers):
            is_member = position < members
            made.append(self._wanted_field(number, fields, depth, choice if is_member else NONE))
        count = self._last_of_members - cleared if of_one else 0
        return [self._clearing(each, cleared, count) for each in made]

    _last_of_members = 0

    @staticmethod
    def _clearing(made: WantedField, first: int, count: int) -> WantedField:
        return made if made.choice == NONE else WantedField(**{**made.__dict__, "cleared": (first, count)})

    def _wanted_field(self, number: int, fields: Fields, depth: int, choice: int) -> WantedField:
        noise = self.noise
        kind = "GROUP" if choice != NONE and noise.random() < 0.1 else noise.choice(_PROTOBUF_SCALARS)
        is_message = depth < 3 and noise.random() < 0.3
        is_repeated = choice == NONE and noise.random() < 0.35 and kind != "GROUP"
        presence = NONE
        if not is_repeated and noise.random() < 0.3:
            presence = self.slot()
            fields.values.append((presence, TRUTH))
        made = self._message_field if is_message else self._scalar_field
        result = made(number, "MESSAGE" if is_message else kind, fields, depth, is_repeated, presence, choice)
        if choice != NONE:
            self._last_of_members = self.slots
        return result

    def _message_field(
        self, number: int, kind: str, fields: Fields, depth: int, is_repeated: bool, presence: int, choice: int
    ) -> WantedField:
        if is_repeated:
            slot = self.slot()
            fields.lists.append(Listed(slot, "message", section=self.section(depth + 1)))
            return WantedField(number, f"TYPE_{kind}", slot, True)
        section = self.section(depth + 1, fields)
        return WantedField(number, f"TYPE_{kind}", presence=presence, section=section, choice=choice)

    def _scalar_field(
        self, number: int, kind: str, fields: Fields, depth: int, is_repeated: bool, presence: int, choice: int
    ) -> WantedField:
        if kind == "GROUP":
            return WantedField(number, "TYPE_GROUP", presence=presence, choice=choice)
        slot = self.slot() if self.noise.random() < 0.9 else NONE
        closed = 0 if kind == "CLOSED_ENUM" else NONE
        of = {"BOOL": TRUTH, "BYTES": TEXT, "FLOAT": REAL, "DOUBLE": REAL}.get(kind, INTEGER)
        if slot != NONE and is_repeated:
            fields.lists.append(Listed(slot, of))
        elif slot != NONE:
            fields.values.append((slot, of))
        return WantedField(number, f"TYPE_{kind}", slot, is_repeated, presence, choice=choice, closed=closed)

    # CDR

    def _steps(self, index: int, depth: int) -> list[Step]:
        fields, steps = self.fields[index], []
        for _ in range(self.noise.randint(1, 6)):
            steps += self._member(fields, depth)
        return steps

    def _member(self, fields: Fields, depth: int) -> list[Step]:
        noise, name = self.noise, self.noise.choice(_SCALARS)
        of = TRUTH if name == "BOOL" else REAL if name.startswith("FLOAT") else INTEGER
        match noise.choice(["scalar", "scalar", "skip", "array", "sequence", "text", "texts", "each"]):
            case "scalar":
                fields.values.append((slot := self.slot(), of))
                return [Step("READ_SCALAR", slot, type=f"SCALAR_{name}")]
            case "skip":
                return [Step("READ_SKIP", size=_SIZES[name], count=noise.randint(1, 4))]
            case "array" | "sequence" as kind:
                is_wanted = kind == "array" or noise.random() < 0.7
                slot = self.slot() if is_wanted else NONE
                if is_wanted:
                    fields.lists.append(Listed(slot, of, C[f"SCALAR_{name}"]))
                return [Step(f"READ_{kind.upper()}", slot, size=_SIZES[name], count=noise.randint(1, 4))]
            case "text":
                slot = self.slot() if noise.random() < 0.7 else NONE
                if slot != NONE:
                    fields.values.append((slot, TEXT))
                return [Step("READ_TEXT", slot)]
            case "texts":
                fields.lists.append(Listed(slot := self.slot(), TEXT))
                return [self._each(NONE), Step("READ_TEXTS", slot), Step("READ_AGAIN")]
        return self._messages(fields, depth)

    def _messages(self, fields: Fields, depth: int) -> list[Step]:
        if depth >= 3:
            return [Step("READ_SKIP", size=1, count=1)]
        slot = self.slot() if self.noise.random() < 0.8 else NONE
        section = self.section(depth + 1)
        if slot != NONE:
            fields.lists.append(Listed(slot, "message", section=section))
        skipped = self.sections[section]
        assert skipped is not None
        return [self._each(slot), *_unwanted(skipped.reads), Step("READ_AGAIN")]  # type: ignore[arg-type]

    def _each(self, slot: int) -> Step:
        if self.noise.random() < 0.7:
            return Step("READ_EACH_SEQUENCE", slot)
        return Step("READ_EACH", slot, count=self.noise.randint(1, 3))


def _unwanted(steps: list[Step]) -> list[Step]:
    """The same steps over what is not wanted."""
    made = []
    for step in steps:
        if step.kind == "READ_SCALAR":
            made.append(Step("READ_SKIP", size=_SIZES[step.type.removeprefix("SCALAR_")], count=1))
        elif step.kind == "READ_ARRAY":
            made.append(Step("READ_SKIP", size=step.size, count=step.count))
        elif step.kind == "READ_TEXTS":
            made.append(Step("READ_TEXT"))
        else:
            made.append(Step(step.kind, size=step.size, type=step.type, count=step.count))
    return made


class _Expressions:
    """Makes programs that leave a value on the stack, of what is there in slots."""

    def __init__(self, layouts: _Layouts) -> None:
        self.noise, self.layouts = layouts.noise, layouts
        self.fields = Fields(
            [(RECEIVED_AT, INTEGER), (SOURCE, TEXT), *layouts.fields[0].values], [*layouts.fields[0].lists]
        )
        self.loops = 0
        self.boldness = self.noise.choice([0.05, 0.05, 0.5, 1.0])  # how many of the operations that may refuse stay

    def of(self, kind: str, depth: int = 4) -> Code:
        slots = self.fields.of(kind)
        if depth <= 0 or self.noise.random() < 0.15:
            return [load(self.noise.choice(slots))] if slots and self.noise.random() < 0.8 else self._constant(kind)
        if self.noise.random() < 0.1:
            return self._choice(kind, depth)
        made = {INTEGER: self._integer, REAL: self._real, TRUTH: self._truth, TEXT: self._text}[kind](depth)
        return made if self.noise.random() < self.boldness else [*made[:-1], *self._tamed(made[-1], kind)]

    def _tamed(self, operation: Operation, kind: str) -> Code:
        """Another operation in place of one that may refuse a message."""
        name = operation.name.removeprefix("OP_")
        if name in {"CHECKED_ADD", "CHECKED_SUBTRACT", "CHECKED_MULTIPLY", "DIVIDE", "MODULO"}:
            return [Operation("OP_MULTIPLY")]
        if name in {"FIT", "WRAP"}:
            return [Operation("OP_CLAMP", flag=operation.flag)]
        if name in {"REAL_DIVIDE", "REAL_FLOOR_DIVIDE", "REAL_MODULO", "REAL_POWER", "HYPOT"}:
            return [Operation("OP_REAL_SUBTRACT")]
        if name in {"SQRT", "SIN", "COS", "TAN", "FLOAT32"}:
            return [Operation("OP_REAL_NEGATE")]
        if name in {"ELEMENT", "OCTETS", "ROUND", "TRUNCATE", "FLOOR", "CEIL"}:
            return [Operation("OP_DROP"), *self._constant(kind)]
        return [] if name in {"UTF8", "FIT_SIZE", "MEMBER"} else [operation]

    def _constant(self, kind: str) -> Code:
        match kind:
            case "integer":
                return [integer(self.noise.choice(_INTEGERS))]
            case "real":
                return [real(self.noise.choice(_REALS))]
            case "truth":
                return [integer(self.noise.randrange(2))]
        return [text(self.noise.choice(_TEXTS))]

    def _choice(self, kind: str, depth: int) -> Code:
        body, orelse = self.of(kind, depth - 1), self.of(kind, depth - 1)
        skip = [Operation("OP_UNLESS", size=len(body) + 1), *body, Operation("OP_JUMP", size=len(orelse)), *orelse]
        return [*self.of(TRUTH, depth - 1), *skip]

    def _many(self, kind: str, count: int, depth: int) -> Code:
        return [operation for _ in range(count) for operation in self.of(kind, depth - 1)]

    def _integer(self, depth: int) -> Code:
        noise, flag = self.noise, self.noise.choice([0, 0, self.noise.randrange(16)])
        two = ["ADD", "SUBTRACT", "MULTIPLY", "CHECKED_ADD", "CHECKED_SUBTRACT", "CHECKED_MULTIPLY", "DIVIDE", "MODULO",
               "LEAST", "GREATEST"]  # fmt: skip
        match noise.choice(["two", "two", "one", "three", "rounded", "of_text", "of_list", "member", "sum", "kept"]):
            case "two":
                return [*self._many(INTEGER, 2, depth), Operation(f"OP_{noise.choice(two)}", flag=flag)]
            case "one":
                name = noise.choice(["NEGATE", "CHECKED_NEGATE", "ABSOLUTE"])
                return [*self.of(INTEGER, depth - 1), Operation(f"OP_{name}", flag=flag)]
            case "three":
                return [
                    *self._many(INTEGER, 3, depth),
                    Operation(f"OP_{noise.choice(['CLAMP', 'FIT', 'WRAP'])}", flag=flag),
                ]
            case "rounded":
                name = noise.choice(["ROUND", "TRUNCATE", "FLOOR", "CEIL"])
                return [*self.of(REAL, depth - 1), Operation(f"OP_{name}")]
            case "of_text":
                return [*self.of(TEXT, depth - 1), Operation(noise.choice(["OP_CHARACTERS", "OP_SIZE"]))]
            case "of_list":
                code, _ = self.list_of(INTEGER, depth)
                return [*code, Operation("OP_SIZE")]
            case "member":
                data = b"".join(number.to_bytes(4, "little", signed=True) for number in (-7, 0, 1, 2, 3, 100, 255))
                return [*self.of(INTEGER, depth - 1), Operation("OP_MEMBER", data=data, size=7)]
            case "sum":
                return self._sum(INTEGER, [integer(0)], Operation("OP_CHECKED_ADD"), depth)
        slot = self.layouts.slot()
        return [*self.of(INTEGER, depth - 1), Operation("OP_KEEP", slot), Operation("OP_DROP"), load(slot)]

    def _real(self, depth: int) -> Code:
        noise = self.noise
        two = ["REAL_ADD", "REAL_SUBTRACT", "REAL_MULTIPLY", "REAL_DIVIDE", "REAL_FLOOR_DIVIDE", "REAL_MODULO",
               "REAL_POWER", "REAL_LEAST", "REAL_GREATEST", "ATAN2", "HYPOT"]  # fmt: skip
        one = ["REAL_NEGATE", "REAL_ABSOLUTE", "SQRT", "SIN", "COS", "TAN", "FLOAT32"]
        match noise.choice(["two", "two", "one", "three", "integer", "element", "sum"]):
            case "two":
                return [*self._many(REAL, 2, depth), Operation(f"OP_{noise.choice(two)}")]
            case "one":
                return [*self.of(REAL, depth - 1), Operation(f"OP_{noise.choice(one)}")]
            case "three":
                return [*self._many(REAL, 3, depth), Operation("OP_REAL_CLAMP")]
            case "integer":
                return [*self.of(INTEGER, depth - 1), Operation("OP_INTEGER_TO_REAL", flag=noise.randrange(2))]
            case "element":
                return self._element(REAL, depth)
        return self._sum(REAL, [real(0)], Operation("OP_REAL_ADD"), depth)

    def _truth(self, depth: int) -> Code:
        noise = self.noise
        match noise.choice(["compare", "compare", "not", "and", "or", "either", "element"]):
            case "compare":
                return self._compare(depth)
            case "not":
                return [*self.of(TRUTH, depth - 1), Operation("OP_NOT")]
            case "and" | "or" as name:
                second = self.of(TRUTH, depth - 1)
                return [*self.of(TRUTH, depth - 1), Operation(f"OP_{name.upper()}", size=len(second)), *second]
            case "either":
                return [*self._many(TRUTH, 2, depth), Operation("OP_EITHER")]
        return self._element(TRUTH, depth)

    def _compare(self, depth: int) -> Code:
        kinds = {"SIGNED_INTEGERS": (INTEGER, INTEGER), "UNSIGNED_INTEGERS": (INTEGER, INTEGER),
                 "SIGNED_WITH_UNSIGNED": (INTEGER, INTEGER), "SIGNED_WITH_REAL": (INTEGER, REAL),
                 "UNSIGNED_WITH_REAL": (INTEGER, REAL), "REALS": (REAL, REAL), "TEXTS": (TEXT, TEXT)}  # fmt: skip
        name = self.noise.choice([*kinds])
        operands = [operation for kind in kinds[name] for operation in self.of(kind, depth - 1)]
        return [*operands, Operation("OP_COMPARE", C[name], flag=self.noise.randrange(6))]

    def _text(self, depth: int) -> Code:
        noise = self.noise
        match noise.choice(["join", "decimal", "digits", "checked", "fit", "octets", "element"]):
            case "join":
                return [*self._many(TEXT, 2, depth), Operation("OP_JOIN")]
            case "decimal":
                return [*self.of(INTEGER, depth - 1), Operation("OP_DECIMAL", flag=noise.randrange(2))]
            case "digits":
                return [*self.of(REAL, depth - 1), Operation("OP_DIGITS", noise.randrange(18))]
            case "checked":
                return [*self.of(TEXT, depth - 1), Operation("OP_UTF8")]
            case "fit":
                return [*self.of(TEXT, depth - 1), Operation("OP_FIT_SIZE", number=noise.choice([0, 9, 100]))]
            case "octets":
                code, stored = self.list_of(INTEGER, depth)
                return [*code, Operation("OP_OCTETS", flag=stored)]
        return self._element(TEXT, depth)

    # lists

    def list_of(self, kind: str, depth: int) -> tuple[Code, int]:
        """A program that leaves a list, and how this is stored."""
        noise, there = self.noise, [each for each in self.fields.lists if each.element == kind]
        if there and (depth <= 1 or noise.random() < 0.5):
            found = noise.choice(there)
            if found.stored != IN_CELLS and noise.random() < 0.3:
                return [load(found.slot), Operation("OP_UNPACK", flag=found.stored)], IN_CELLS
            return [load(found.slot)], found.stored
        if depth <= 1 or self.loops >= 4 or noise.random() < 0.4:
            count = noise.randrange(4)
            return [*self._many(kind, count, depth), Operation("OP_LIST", size=count)], IN_CELLS
        return self._computed(kind, depth), IN_CELLS

    def _computed(self, kind: str, depth: int) -> Code:
        """A list that is made element by element of another one."""
        of = self.noise.choice([INTEGER, REAL, TRUTH, TEXT])
        made = self.layouts.slot()
        start = [Operation("OP_LIST"), Operation("OP_KEEP", made), Operation("OP_DROP")]

        def body(element: int) -> Code:
            self.fields.values.append((element, of))
            code = self.of(kind, depth - 2)
            self.fields.values.remove((element, of))
            return [Operation("OP_KEEP", element), Operation("OP_DROP"), *code, Operation("OP_APPEND", made)]

        return [*start, *self.for_each(*self.list_of(of, depth - 1), body, keeps=True), load(made)]

    def for_each(self, code: Code, stored: int, body: Callable[[int], Code], *, keeps: bool) -> Code:
        """Execute what `body` gives for each element, which is on the stack first."""
        left, element = self.layouts.slot(), self.layouts.slot()
        self.loops += 1
        inner = [Operation("OP_NEXT", left, flag=stored), *body(element), Operation("OP_AGAIN")]
        self.loops -= 1
        start = [*code, Operation("OP_KEEP", left), Operation("OP_SIZE")]
        return [*start, Operation("OP_REPEAT", flag=int(keeps), size=len(inner)), *inner]

    def _sum(self, kind: str, start: Code, operation: Operation, depth: int) -> Code:
        if self.loops >= 4:
            return start
        return [*start, *self.for_each(*self.list_of(kind, depth - 1), lambda _: [operation], keeps=False)]

    def _element(self, kind: str, depth: int) -> Code:
        code, stored = self.list_of(kind, depth)
        return [*code, Operation("OP_ELEMENT", flag=stored, number=self.noise.randrange(3))]

    def for_elements(self, listed: Listed, body: Callable[[], Code]) -> Code:
        """Execute what `body` gives for each message of a list, with its fields."""

        def entered(_: int) -> Code:
            fields, outer = self.layouts.fields[listed.section], self.fields
            self.fields = Fields([*outer.values, *fields.values], [*outer.lists, *fields.lists])
            made = [Operation("OP_ENTER", listed.section), *body()]
            self.fields = outer
            return made

        return self.for_each([load(listed.slot)], listed.stored, entered, keeps=False)


class _Messages:
    """Makes programs that write a message."""

    def __init__(self, expressions: _Expressions, *, is_cdr: bool) -> None:
        self.expressions, self.noise, self.is_cdr = expressions, expressions.noise, is_cdr

    def message(self) -> Code:
        head = [Operation("OP_KNOWN", 1, data=CDR_HEADER)] if self.is_cdr else []
        return [*head, *self._fields(3)]

    def _fields(self, depth: int) -> Code:
        return [operation for _ in range(self.noise.randint(1, 5)) for operation in self._field(depth)]

    def _field(self, depth: int) -> Code:
        messages = [each for each in self.expressions.fields.lists if each.element == "message"]
        if messages and depth and self.expressions.loops < 3 and self.noise.random() < 0.5:
            return self.expressions.for_elements(self.noise.choice(messages), lambda: self._enclosed(depth - 1))
        if self.noise.random() < 0.1 * self.expressions.boldness:
            fits = Operation("OP_FIT_COUNT", flag=self.noise.randrange(2), number=self.noise.randrange(2))
            return [*self.expressions.of(TRUTH), fits, Operation("OP_DROP"), *self._value()]
        if depth and self.noise.random() < 0.3:
            return self._enclosed(depth - 1)
        if depth and self.noise.random() < 0.3:
            return self._list()
        return self._value()

    def _enclosed(self, depth: int) -> Code:
        if self.is_cdr:
            return self._fields(depth)
        tag = self._number() << 3 | 2
        return [
            Operation("OP_OPEN", flag=self.noise.randrange(2), size=tag),
            *self._fields(depth),
            Operation("OP_CLOSE"),
        ]

    def _number(self) -> int:
        return self.noise.choice([1, 2, 15, 16, 2047, 2048, (1 << 29) - 1])

    def _list(self) -> Code:
        kind = self.noise.choice([INTEGER, REAL])
        code, stored = self.expressions.list_of(kind, 4)
        is_real = kind == REAL
        if self.is_cdr:
            length = [*code, Operation("OP_SIZE"), Operation("OP_PUT", 4)]
            put = Operation("OP_PUT_DOUBLE") if is_real else Operation("OP_PUT", 8)
            return [*length, *self.expressions.for_each(code, stored, lambda _: [put], keeps=False)]
        is_packed = self.noise.random() < 0.5
        put = self._write("DOUBLE" if is_real else "VARINT", 0 if is_packed else self._number())
        each = self.expressions.for_each(code, stored, lambda _: [put], keeps=False)
        return [Operation("OP_OPEN", size=self._number() << 3 | 2), *each, Operation("OP_CLOSE")] if is_packed else each

    def _write(self, name: str, number: int) -> Operation:
        wire_type = {"VARINT": 0, "ZIGZAG": 0, "FIXED32": 5, "FLOAT": 5, "BYTES": 2}.get(name, 1)
        return Operation(
            f"OP_WRITE_{name}", flag=self.noise.randrange(2), size=number << 3 | wire_type if number else 0
        )

    def _value(self) -> Code:
        noise, of = self.noise, self.expressions.of
        kind = noise.choice([INTEGER, REAL, TEXT, "known"])
        if kind == "known":
            return [Operation("OP_KNOWN", noise.choice([1, 2, 4, 8]) if self.is_cdr else 1, data=noise.randbytes(9))]
        return [*of(kind), self._put(kind) if self.is_cdr else self._write(noise.choice(_WRITES[kind]), self._number())]

    def _put(self, kind: str) -> Operation:
        if kind == INTEGER:
            return Operation("OP_PUT", self.noise.choice([1, 2, 4, 8]))
        names = {REAL: ["OP_PUT_FLOAT", "OP_PUT_DOUBLE"], TEXT: ["OP_PUT_TEXT", "OP_PUT_BYTES"]}
        return Operation(self.noise.choice(names[kind]))


_WRITES = {INTEGER: ["VARINT", "ZIGZAG", "FIXED32", "FIXED64"], REAL: ["FLOAT", "DOUBLE"], TEXT: ["BYTES"]}


def random_program(seed: int) -> Program:
    """From either format to either."""
    noise = random.Random(seed)
    while True:
        layouts = _Layouts(noise, is_cdr=noise.random() < 0.5)
        expressions = _Expressions(layouts)
        condition = expressions.of(TRUTH)
        message = _Messages(expressions, is_cdr=noise.random() < 0.5).message()
        if layouts.slots < MOST_SLOTS and len(message) < 2000:
            return Program(layouts.layout, condition, message)
