"""Random datagrams from pieces of the wire format, mostly well formed according to a schema, and damaged ones."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.types.case_by import ByName
from router.types.protobuf import Envelope
from tests.envelopes import I32, I64, LEN, VARINT, framed, tag, varint
from tests.mutations import MUTATIONS

GROUP, GROUP_END = 3, 4

_FIXED32 = {FieldDescriptor.TYPE_FLOAT, FieldDescriptor.TYPE_FIXED32, FieldDescriptor.TYPE_SFIXED32}
_FIXED64 = {FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FIXED64, FieldDescriptor.TYPE_SFIXED64}
_LENGTHY = {FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES, FieldDescriptor.TYPE_MESSAGE}

_TEXTS = (b"", b"\0", b"a", b"abcdefgh" * 5, *(text.encode() for text in ("\x80", "\u07ff", "\u0800", "\uffff")))
_EDGES = (
    "\ud7ff".encode(), "\ue000".encode(), "\U00010000".encode(), "\U0010ffff".encode(),
    b"\xc1\xbf", b"\xe0\x9f\xbf", b"\xed\xa0\x80", b"\xf0\x8f\xbf\xbf", b"\xf4\x90\x80\x80", b"\xf5\x80\x80\x80",
    b"\x80", b"\xc2", b"\xe1\x80", b"\xf1\x80\x80", b"\xff", b"a\xe2\x82", b"\xc2\x80\x80", b"\xe2\x28\xa1",
)  # fmt: skip


def maker_for(envelope: Envelope, noise: random.Random) -> Maker:
    descriptor: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]  # or upb's
    if not isinstance(envelope.choice, ByName):
        return Maker(descriptor, noise)
    cases = [case.message_class.DESCRIPTOR for case in envelope.cases.values()]
    numbers = envelope.choice.name[1], envelope.choice.data[1]
    return NamedMaker(descriptor, noise, cases, *numbers)  # type: ignore[arg-type]  # or upb's


class Maker:
    """Makes datagrams for an envelope with the random numbers of `noise`."""

    def __init__(self, envelope: Descriptor, noise: random.Random) -> None:
        self._envelope = envelope
        self._noise = noise
        self._room = 0

    def datagram(self) -> bytes:
        """An envelope, usually with exactly one payload, and sometimes damaged."""
        data = self.envelope()
        other = data
        for _ in range(self._noise.choice((0, 0, 0, 1, 1, 2))):
            if not data:
                break
            if self._noise.random() < 0.3:
                other = self.envelope() or b"\0"
            data = self._noise.choice(MUTATIONS)(self._noise, data, other)
        return data

    def envelope(self) -> bytes:
        self._room = self._noise.choice((5, 30, 120))
        fields = self._envelope.fields
        oneof = [field for field in fields if field.containing_oneof is not None] or fields
        parts = [self._known(self._noise.choice(oneof)) for _ in range(self._noise.choice((0, 1, 1, 1, 1, 1, 2)))]
        if self._noise.random() < 0.3:
            parts.append(self._message(self._envelope))
        self._noise.shuffle(parts)
        return b"".join(parts)

    def message(self) -> bytes:
        """A message of the envelope's type, usually without a payload."""
        self._room = self._noise.choice((5, 30, 120))
        return self._message(self._envelope)

    def _message(self, descriptor: Descriptor) -> bytes:
        """Some of the message's fields, in any order, and sometimes an unknown one."""
        parts = []
        fields = [*descriptor.fields]
        if descriptor.is_extendable:
            fields += descriptor.file.pool.FindAllExtensions(descriptor)
        for _ in range(self._noise.choice((0, 1, 2, 3, 6))):
            if self._room <= 0:
                break
            self._room -= 1
            if fields and self._noise.random() < 0.95:
                parts.append(self._known(self._noise.choice(fields)))
            else:
                parts.append(self._unknown())
        return b"".join(parts)

    def _known(self, field: FieldDescriptor) -> bytes:
        """A field with its declared wire type or another one."""
        if self._noise.random() < 0.02:
            return self._value(field.number, self._noise.choice((VARINT, I64, LEN, GROUP, I32)))
        if field.type == FieldDescriptor.TYPE_GROUP:
            return self._group(field.number, lambda: self._inner(field))
        if field.type in _LENGTHY:
            return self._len(field.number, self._content(field))
        if field.is_repeated and self._noise.random() < 0.6:
            return self._len(field.number, self._packed(field))
        wire_type = I32 if field.type in _FIXED32 else I64 if field.type in _FIXED64 else VARINT
        return self._value(field.number, wire_type)

    def _content(self, field: FieldDescriptor) -> bytes:
        if field.message_type is not None:
            return self._inner(field)
        parts = self._noise.choices(_TEXTS, k=self._noise.randrange(4))
        if self._noise.random() < 0.1:
            parts.append(self._noise.choice(_EDGES))
        self._noise.shuffle(parts)
        return b"".join(parts)

    def _inner(self, field: FieldDescriptor) -> bytes:
        """The fields of a message or group, sometimes nested about as deeply as protobuf allows."""
        assert field.message_type is not None
        content = self._message(field.message_type)
        if self._noise.random() > 0.02:
            return content
        recursive = [each for each in field.message_type.fields if each.message_type is field.message_type]
        for _ in range(self._noise.randrange(95, 103) if recursive or self._noise.random() < 0.3 else 0):
            content = self._wrapped(self._noise.choice(recursive) if recursive else None, content)
        return content

    def _wrapped(self, field: FieldDescriptor | None, content: bytes) -> bytes:
        if field is None:
            return tag(99, GROUP) + content + tag(99, GROUP_END)
        if field.type == FieldDescriptor.TYPE_GROUP:
            return tag(field.number, GROUP) + content + tag(field.number, GROUP_END)
        return self._len(field.number, content)

    def _packed(self, field: FieldDescriptor) -> bytes:
        count = self._noise.choice((0, 1, 2, 3, 20))
        if field.type in _FIXED32 or field.type in _FIXED64:
            size = 4 if field.type in _FIXED32 else 8
            return self._noise.randbytes(count * size + (self._noise.random() < 0.05))
        values = b"".join(self._varint() for _ in range(count))
        return values[:-1] if self._noise.random() < 0.05 else values

    def _unknown(self) -> bytes:
        number = self._noise.choice((0, 1, 17, 30, 99, 2047, 2048, 99999, 2**29 - 1))
        return self._value(number, self._noise.choice((VARINT, I64, LEN, GROUP, I32, I32, LEN, VARINT, 4, 6, 7)))

    def _value(self, number: int, wire_type: int) -> bytes:
        """Any value of a wire type; empty for wire types without a value."""
        if wire_type == GROUP:
            return self._group(number, lambda: b"".join(self._unknown() for _ in range(self._noise.randrange(3))))
        if wire_type == LEN:
            return self._len(number, self._noise.choice((b"", b"\0\0", b"\x08\x01", b"\x0b\x0c", self._varint() * 2)))
        head = self._tag(number, wire_type)
        if wire_type == VARINT:
            return head + self._varint()
        zeros_too = self._noise.choice((bytes(8), self._noise.randbytes(8)))
        return head + zeros_too[: {I32: 4, I64: 8}.get(wire_type, 0)]

    def _group(self, number: int, content: Callable[[], bytes]) -> bytes:
        end = number if self._noise.random() < 0.97 else self._noise.choice((0, 1, number + 1))
        if self._room <= 0:
            return b""
        self._room -= 1
        return self._tag(number, GROUP) + content() + self._tag(end, GROUP_END)

    def _len(self, number: int, content: bytes) -> bytes:
        size = len(content)
        if self._noise.random() < 0.01:
            size = self._noise.choice((size + 1, size - 1, 2**31 - 1, 2**31, 2**32 + size, 2**64 - 1))
        return self._tag(number, LEN) + self._stretched(varint(size % 2**64)) + content

    def _tag(self, number: int, wire_type: int) -> bytes:
        return self._stretched(tag(number, wire_type))

    def _stretched(self, encoded: bytes) -> bytes:
        """A varint, sometimes longer than necessary, up to one byte more than the maximum."""
        if self._noise.random() > 0.02:
            return encoded
        longest: Sequence[int] = range(len(encoded) + 1, 12)
        more = self._noise.choice(longest or (len(encoded) + 1,)) - len(encoded)
        return encoded[:-1] + bytes((encoded[-1] | 0x80,)) + b"\x80" * (more - 1) + b"\0"

    def _varint(self) -> bytes:
        value = self._noise.choice((0, 1, 2, 127, 128, 300, 2**31, 2**32 - 1, 2**63, 2**64 - 1))
        if self._noise.random() < 0.02:
            return b"\xff" * 9 + self._noise.choice((b"\0", b"\1", b"\2", b"\x7f", b"\xff\1"))
        return self._stretched(varint(value))


class NamedMaker(Maker):
    """Makes envelopes with the name of a message and its bytes, usually one of each."""

    def __init__(
        self, envelope: Descriptor, noise: random.Random, cases: Sequence[Descriptor], name: int, data: int
    ) -> None:
        super().__init__(envelope, noise)
        self._cases = cases
        self._name, self._data = name, data

    def envelope(self) -> bytes:
        noise, case = self._noise, self._noise.choice(self._cases)
        names = case.full_name, case.full_name.lower(), f"/{case.full_name}", case.full_name[:-1], ""
        texts = [noise.choices(names, (20, 1, 1, 1, 1))[0].encode() for _ in range(noise.choice((0, 1, 1, 1, 1, 1, 2)))]
        payload = Maker(case, noise)
        parts = [framed(self._name, text) for text in texts]
        parts += [framed(self._data, payload.message()) for _ in range(noise.choice((0, 1, 1, 1, 1, 1, 2)))]
        parts += [b"".join((tag(noise.choice((1, 2, 3, 99)), VARINT), b"\1"))] * noise.choice((0, 0, 0, 1))
        noise.shuffle(parts)
        return b"".join(parts)
