"""Datagrams that are not exactly one protobuf message: trailing zeros removed by the sender, or added.

The protocol lets a sender leave out the zeros at the end of an envelope, and boards may send frames of a
fixed size that are filled up with zeros. Both can be undone, because a tag is never zero and the last
field says how long it is. Knows the wire format, and no message.
"""

from __future__ import annotations

VARINT, I64, LEN, I32 = 0, 1, 2, 5
_FIXED = {I64: 8, I32: 4}
_LONGEST_VARINT = 10


def restored(data: bytes, limit: int) -> bytes:
    """The envelope with the zeros that it had when it was encoded.

    What cannot be such an envelope comes back as it is, for the parser to refuse: a cut tag or length,
    groups, or a field that would make it longer than `limit` bytes. Equal input and output means nothing
    was done. A datagram that was cut inside its last field cannot be told from one whose zeros were
    removed; its payload then most often has a zero for a tag, which the parser refuses.
    """
    position, size = 0, len(data)
    try:
        while position < size:
            if data[position] == 0:
                return data if data[position:].strip(b"\0") else data[:position]
            tag, position = _varint(data, position)
            wire_type = tag & 7
            if wire_type in _FIXED:
                position += _FIXED[wire_type]
            elif wire_type not in (VARINT, LEN):
                return data
            elif position == size:
                position += 1  # the value or the length was zero
            else:
                value, position = _varint(data, position)
                position += value if wire_type == LEN else 0
    except IndexError:
        return data
    return data if position > limit else data.ljust(position, b"\0")


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """A varint and the position behind it. Raises IndexError for one that is cut or too long.

    Its last byte is no zero, or it is a single byte; so one that goes on behind the end lacks more than zeros.
    """
    value = 0
    for index in range(_LONGEST_VARINT):
        byte = data[position + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, position + index + 1
    raise IndexError
