"""Trailing zeros of envelopes, which a sender may omit or add.

The protocol lets a sender omit the zeros at the end of an envelope, and boards may send frames of a fixed size, padded
with zeros. Both can be undone, because a tag is never zero and the last field states its length.
"""

from __future__ import annotations

from router.declared import MAX_DATAGRAM
from router.types.wire import I32, I32_SIZE, I64, I64_SIZE, LEN, VARINT, read_varint

_FIXED = {I64: I64_SIZE, I32: I32_SIZE}
"""Bytes of a value, by wire type."""


def restored(data: bytes, limit: int = MAX_DATAGRAM) -> bytes:
    """Return the envelope with the trailing zeros that it had when it was encoded.

    Returns `data` itself if it is complete or cannot be such an envelope: a truncated tag, groups, or a field that
    would make it longer than `limit` bytes. A datagram truncated inside its last field looks like one whose zeros were
    removed; its payload then usually has a zero as a tag, which the parser rejects.
    """
    position, size = 0, len(data)
    with_zero = data + b"\0"
    try:
        while position < size:
            if data[position] == 0:
                return data if data[position:].strip(b"\0") else data[:position]
            tag, position = read_varint(data, position)
            wire_type = tag & 7
            if wire_type in _FIXED:
                position += _FIXED[wire_type]
            elif wire_type == LEN:
                length, position = read_varint(with_zero, position)  # `c2 01 80` was `c2 01 80 00`
                position += length
            elif wire_type != VARINT:
                return data
            elif position == size:
                position += 1  # the removed value was zero
            else:
                _, position = read_varint(data, position)
    except IndexError:
        return data
    return data if position > limit else data.ljust(position, b"\0")


def trimmed(data: bytes) -> bytes:
    """Return an envelope without its trailing zeros, if `restored` can reconstruct them from the rest."""
    bare = data.rstrip(b"\0")
    return bare if restored(bare) == data else data
