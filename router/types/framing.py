"""The zeros at the end of an envelope: which a sender may leave out, or add.

The protocol lets a sender leave out the zeros at the end of an envelope, and boards may send frames of a fixed size,
padded with zeros. Both can be undone, because a tag is never zero and the last field states its length.
"""

from __future__ import annotations

from router.types.wire import LEN

MAX_DATAGRAM = 16 * 1024
"""The longest accepted datagram, in bytes; a longer one is rejected as `truncated`."""

_VARINT = 0
_FIXED = {1: 8, 5: 4}
"""Bytes of a value, by wire type."""

_LONGEST_VARINT = 10


def restored(data: bytes, limit: int = MAX_DATAGRAM) -> bytes:
    """Return the envelope with the trailing zeros that it had when it was encoded.

    Returns `data` itself where that is complete, or cannot be such an envelope: a cut tag, groups, or a field that
    would make it longer than `limit` bytes. A datagram that was cut inside its last field looks like one whose zeros
    were removed; its payload then most often has a zero for a tag, which the parser refuses.
    """
    position, size = 0, len(data)
    with_zero = data + b"\0"
    try:
        while position < size:
            if data[position] == 0:
                return data if data[position:].strip(b"\0") else data[:position]
            tag, position = _varint(data, position)
            wire_type = tag & 7
            if wire_type in _FIXED:
                position += _FIXED[wire_type]
            elif wire_type == LEN:
                length, position = _varint(with_zero, position)  # `c2 01 80` was `c2 01 80 00`
                position += length
            elif wire_type != _VARINT:
                return data
            elif position == size:
                position += 1  # the value was zero
            else:
                _, position = _varint(data, position)
    except IndexError:
        return data
    return data if position > limit else data.ljust(position, b"\0")


def trimmed(data: bytes) -> bytes:
    """Return an envelope without its trailing zeros, if `restored` can tell from the rest how many there were."""
    bare = data.rstrip(b"\0")
    return bare if restored(bare) == data else data


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a varint and the position behind it. Raises IndexError for one that is cut or too long."""
    value = 0
    for index in range(_LONGEST_VARINT):
        byte = data[position + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, position + index + 1
    raise IndexError
