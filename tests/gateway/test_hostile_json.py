"""Damaged and hostile messages: bytes that the reference reads, or one of two errors, and nothing else."""

from __future__ import annotations

import copy
import json
import random
from typing import Any

import pytest

from router.gateway.json_codec import InvalidMessageError, decoder
from router.gateway.json_types import Style, example
from router.gateway.packets import PacketError
from router.rehearsal.cdr import deserialize as parse
from router.types.model import Bool, Field, Float, Int, List, MessageType, String
from router.types.ros import ros_interfaces
from tests.gateway.client_json import tree

EVERYTHING = MessageType(
    "made/msg/Everything",
    (
        *(Field(f"i{bits}{signed:d}", Int(bits, signed)) for bits in (8, 16, 32, 64) for signed in (False, True)),
        Field("f32", Float(32)),
        Field("f64", Float(64)),
        Field("truth", Bool()),
        Field("text", String(bound=9)),
        Field("wide", String(wide=True)),
        Field("nothing", MessageType("made/msg/Nothing")),
        Field("bytes", List(Int(8, signed=False), bound=5), default=(1, 2)),
        Field("three", List(Float(32), length=3), default=(0.5, 1.5, -2.5)),
        Field("texts", List(String(wide=True)), default=("a", "b")),
        Field("inside", List(MessageType("made/msg/Inside", (Field("x", Float(64)), Field("y", String()))), length=2)),
    ),
)
TYPES = [EVERYTHING, *map(ros_interfaces().get, ("geometry_msgs/msg/TwistStamped", "sensor_msgs/msg/BatteryState"))]

NASTY: list[Any] = [
    None, True, False, -1, 255, 256, 2**31, 2**63, 2**64, -(2**63) - 1, 10**30, 0.0, -0.0, 3.0, 1e39, 1e308, "", "abc",
    "a\0b", "\ud800", "\N{GRINNING FACE}" * 10, [], [[]], [0], [1, 2], [0] * 1000, ["a"], {}, {"x": 1}, {"": {}},
]  # fmt: skip
SCRAPS = [b"[", b"]", b"{", b"}", b'"', b",", b":", b"\\", b"e", b"e999", b"-", b".", b"9" * 30, b"NaN", b"Infinity",
          b"null", b"\xff", b"\xed\xa0\x80", b"\xef\xbb\xbf", b"\0", b"\\ud800", b"[" * 70, b'"x":']  # fmt: skip


def holders(value: Any) -> list[Any]:
    """All lists and objects in a value."""
    inner = value if isinstance(value, list) else value.values() if isinstance(value, dict) else []
    return [value, *(holder for each in inner for holder in holders(each))] if isinstance(value, (list, dict)) else []


def change(value: Any, chance: random.Random) -> None:
    """One thing in a message becomes another: a value, a name, the number of elements."""
    holder = chance.choice(holders(value))
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    key, new = chance.choice(keys or [0]), copy.deepcopy(chance.choice(NASTY))
    act = chance.randrange(4)
    if isinstance(holder, list) and act < 2:
        holder.insert(chance.randrange(len(holder) + 1), new)
    elif isinstance(holder, dict) and act == 0:
        holder[chance.choice(["x", "header", "other", "", "n" * 10_000])] = new
    elif keys and act == 1:
        del holder[key]
    elif keys:
        holder[key] = new


def damage(text: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(text) + 1)
    end = min(len(text), at + chance.choice([0, 0, 1, 2, 50]))
    middle = chance.choice([chance.choice(SCRAPS), bytes([chance.randrange(256)]), text[end:], b""])
    return text[:at] + middle + text[end:]


@pytest.mark.parametrize("declared", TYPES, ids=str)
@pytest.mark.parametrize("style", Style)
def test_mutated_messages_are_refused_or_sound(declared: MessageType, style: Style) -> None:
    chance = random.Random(f"{declared}{style}")
    decode = decoder(declared, style)
    outcomes: list[str] = []
    for _ in range(1000):
        value = tree(declared, example(declared), is_wrapped=style is Style.WRAPPED)
        for _ in range(chance.randrange(3)):
            change(value, chance)
        text = json.dumps(value, ensure_ascii=True).encode()
        for _ in range(chance.randrange(3)):
            text = damage(text, chance)
        try:
            parse(declared, decode(text))
            outcomes.append("")
        except (InvalidMessageError, PacketError) as error:
            outcomes.append(str(error))
    assert outcomes.count("") > 40
    assert len({*outcomes}) > 40
    assert max(map(len, outcomes)) < 250
