"""How an envelope says which messages a frame holds: a class for each `enum case_by` of the carrier.

A frame is a datagram with its trailing zeros restored. The fields of the classes are keys of a table's `envelope`.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby, islice
from typing import TYPE_CHECKING, ClassVar, Union

from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.declared import ONLY_CASE
from router.types.lock_file import BY_ONEOF
from router.types.wire import I32, I32_SIZE, I64, I64_SIZE, LEN, VARINT, delimited, read_varint, varint

if TYPE_CHECKING:
    from router.types.protobuf import Envelope, PayloadCase


@dataclass(frozen=True, order=True, slots=True)
class Wrapping:
    """How an envelope holds a payload: in the field with this tag; with 0 the frame is the payload.

    `before` and `after` are the field with the name of the message. `is_optional`: the field of an empty payload is
    left out. `is_shared`: a frame may hold other payloads, too.
    """

    tag: int
    before: bytes = b""
    after: bytes = b""
    is_optional: bool = False
    is_shared: bool = False

    @property
    def is_alone(self) -> bool:
        """Whether tag and length are all that is added to the payload."""
        return bool(self.tag) and not self.before and not self.after

    def size(self, payload: int) -> int:
        """Return the size in bytes of a frame with only a payload of `payload` bytes."""
        added = len(self.before) + len(self.after)
        return added + (len(varint(self.tag)) + len(varint(payload)) if self.tag else 0) + payload


def named(name: int, text: str, payload: int, *, is_optional: bool) -> Wrapping:
    """Return how an envelope holds a payload, in the field number `payload`, beside its name, in the field `name`."""
    field, tag = delimited(name, text.encode()), payload << 3 | LEN
    around = (field, b"") if name < payload else (b"", field)
    return Wrapping(tag, *around, is_optional=is_optional)


class _ByField:
    """Some fields of the envelope are cases."""

    __slots__ = ()

    def place(self, envelope: str, case: PayloadCase) -> str:
        """Describe where an envelope, by name, holds a payload."""
        return f"field {case.number} of {envelope}"

    def payload(self, frame: Message, case: PayloadCase) -> Message:
        """Return a case that a parsed frame holds. Raises protobuf's DecodeError."""
        inner: Message = getattr(frame, case.member)
        return inner

    def why_none(self, envelope: Envelope, frame: Message) -> tuple[str, str]:
        """Return the reason why a parsed frame holds no case, and the field or name that causes it, or ""."""
        numbers = _unknown_fields(frame)
        cases = {case.number for case in envelope.cases.values()}
        # A payload case among the unknown fields has the wrong wire type.
        if known := [number for number in numbers if number in cases]:
            return "malformed", f"field {known[0]} is not a message"
        return ("unknown_case", f"field {numbers[0]}") if numbers else ("no_payload", "")

    def put(self, frame: Message, case: PayloadCase, payload: Message) -> None:
        """Make this payload, even an empty one, a parsed frame's."""
        inner = getattr(frame, case.member)
        inner.SetInParent()
        inner.CopyFrom(payload)

    def all_members(self, envelope: Envelope, frame: bytes) -> Sequence[str]:
        """Return the cases in a frame in order, also those that later ones supersede; consecutive pieces are one."""
        names = {(case.number, LEN): case.name for case in envelope.cases.values()}
        names |= {(member.number, member.wire_type): name for name, member in envelope.unroutable.items()}
        fields = UnknownFieldSet(Empty.FromString(frame))
        found = [(fields[index].field_number, fields[index].wire_type) for index in range(len(fields))]
        return [name for name, _ in groupby(names[member] for member in found if member in names)]

    def _numbers(self, datagram: bytes, numbers: Container[int]) -> Iterator[int]:
        """Yield the number of each field that is one of the cases with these `numbers`."""
        with suppress(IndexError):
            for tag, _ in _fields(datagram):
                if tag >> 3 in numbers:
                    yield tag >> 3


@dataclass(frozen=True, slots=True)
class ByOneof(_ByField):
    """Each member of a oneof is a case."""

    oneof: str
    kind: ClassVar[str] = "oneof"
    """The name in `enum case_by`."""
    by: ClassVar[str] = BY_ONEOF
    """What the lock file says about it."""
    root: ClassVar[str] = ""
    """The case that the envelope itself is, "" if it only holds them."""

    def members_of(self, frame: Message) -> Sequence[str]:
        """Return the names of the cases that a parsed frame holds, even of those that no route can take."""
        name = frame.WhichOneof(self.oneof)
        return [str(name)] if name is not None else []

    def numbers_in(self, datagram: bytes, numbers: Container[int]) -> Sequence[int]:
        """Return the cases with these `numbers` that a datagram seems to hold; of a oneof, the first member.

        They are found without parsing the datagram, which may be malformed, trimmed or padded.
        """
        return [*islice(self._numbers(datagram, numbers), 1)]


@dataclass(frozen=True, slots=True)
class ByCases(_ByField):
    """Each of these fields that is present is a message. They are in the order of their numbers."""

    cases: Sequence[str]
    kind: ClassVar[str] = "cases"
    by: ClassVar[str] = "cases"
    oneof: ClassVar[str] = ""
    root: ClassVar[str] = ""

    def members_of(self, frame: Message) -> Sequence[str]:
        return [name for name in self.cases if frame.HasField(name)]

    def numbers_in(self, datagram: bytes, numbers: Container[int]) -> Sequence[int]:
        return [*dict.fromkeys(self._numbers(datagram, numbers))]


def _unknown_fields(frame: Message) -> list[int]:
    fields = UnknownFieldSet(frame)
    return [fields[index].field_number for index in range(len(fields))]


def _fields(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the tag of each field, and where its value begins.

    Raises IndexError at the end of data that end early: zeros were trimmed, or they are malformed.
    """
    position = 0
    while position < len(data):
        tag, start = read_varint(data, position)
        yield tag, start
        position = _after(data, start, tag & 7)


def _after(data: bytes, position: int, wire_type: int) -> int:
    """Return the position after a value; for a group, the end. Raises IndexError."""
    if wire_type == VARINT:
        return read_varint(data, position)[1]
    if wire_type == LEN:
        size, position = read_varint(data, position)
        return position + size
    return position + {I64: I64_SIZE, I32: I32_SIZE}.get(wire_type, len(data))


@dataclass(frozen=True, slots=True)
class ByFrame:
    """The frame is the message of the only case, which the table names."""

    case: str
    kind: ClassVar[str] = "frame"
    by: ClassVar[str] = "frame"
    oneof: ClassVar[str] = ""

    @property
    def root(self) -> str:
        return self.case

    def place(self, envelope: str, case: PayloadCase) -> str:
        return "the whole frame"

    def members_of(self, frame: Message) -> Sequence[str]:
        return [self.case]

    def payload(self, frame: Message, case: PayloadCase) -> Message:
        return frame

    def why_none(self, envelope: Envelope, frame: Message) -> tuple[str, str]:
        return "no_payload", ""  # never

    def put(self, frame: Message, case: PayloadCase, payload: Message) -> None:
        frame.CopyFrom(payload)

    def all_members(self, envelope: Envelope, frame: bytes) -> Sequence[str]:
        return [self.case]

    def numbers_in(self, datagram: bytes, numbers: Container[int]) -> Sequence[int]:
        return [ONLY_CASE]


@dataclass(frozen=True, slots=True)
class ByName:
    """A field of the envelope names the message, and another one has its bytes.

    Both are given by name and number. `cases` has name and number of each case by what is in the field.
    """

    name: tuple[str, int]
    data: tuple[str, int]
    cases: Mapping[str, tuple[str, int]]
    kind: ClassVar[str] = "name"
    oneof: ClassVar[str] = ""
    root: ClassVar[str] = ""

    @property
    def by(self) -> str:
        return f"name: {self.name[0]}, {self.data[0]}"

    def place(self, envelope: str, case: PayloadCase) -> str:
        return f"named '{self._text_of(case)}' in {envelope}"

    def members_of(self, frame: Message) -> Sequence[str]:
        found = self.cases.get(getattr(frame, self.name[0]))
        return [found[0]] if found is not None and not self._has_mistyped(frame, self.data) else []

    def _has_mistyped(self, frame: Message, field: tuple[str, int]) -> bool:
        """Return whether a parsed frame has a field only with another wire type."""
        name, number = field
        return not getattr(frame, name) and number in _unknown_fields(frame)

    def payload(self, frame: Message, case: PayloadCase) -> Message:
        return case.message_class.FromString(getattr(frame, self.data[0]))

    def why_none(self, envelope: Envelope, frame: Message) -> tuple[str, str]:
        name: str = getattr(frame, self.name[0])
        if name and name not in self.cases:
            return "unknown_case", f"'{name}'{_alike(name, self.cases)}"
        for field, text in ((self.name, "text"), (self.data, "bytes")):
            if self._has_mistyped(frame, field):
                return "malformed", f"field {field[1]} is not {text}"
        return "no_payload", ""

    def put(self, frame: Message, case: PayloadCase, payload: Message) -> None:
        setattr(frame, self.name[0], self._text_of(case))
        setattr(frame, self.data[0], payload.SerializePartialToString())

    def _text_of(self, case: PayloadCase) -> str:
        return next(text for text, (_, number) in self.cases.items() if number == case.number)

    def all_members(self, envelope: Envelope, frame: bytes) -> Sequence[str]:
        fields = UnknownFieldSet(Empty.FromString(frame))
        found = [fields[index] for index in range(len(fields)) if fields[index].wire_type == LEN]
        texts = [field.data.decode(errors="replace") for field in found if field.field_number == self.name[1]]
        payloads = sum(field.field_number == self.data[1] for field in found)
        texts += texts[-1:] * (payloads - len(texts))
        return [self.cases[text][0] if text in self.cases else text for text in texts]

    def numbers_in(self, datagram: bytes, numbers: Container[int]) -> Sequence[int]:
        text = b""
        with suppress(IndexError):
            for tag, start in _fields(datagram):
                if tag == self.name[1] << 3 | LEN:
                    size, begin = read_varint(datagram, start)
                    text = datagram[begin : begin + size]
        _, number = self.cases.get(text.decode(errors="replace"), ("", 0))
        return [number] if number in numbers else []


def _alike(name: str, known: Iterable[str]) -> str:
    """Return names that differ only in case, prefix or package, in brackets; "" if there are none."""
    alike = [each for each in known if _bare(each) == _bare(name)]
    return f" (known: {', '.join(alike)})" if alike else ""


def _bare(name: str) -> str:
    return name.rpartition("/")[2].rpartition(".")[2].lower()


Choice = Union[ByOneof, ByCases, ByFrame, ByName]
