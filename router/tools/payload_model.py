"""Smoothly moving values for any payload: what the simulator's boards send.

A message type with a model in `models` gets its physics; every other field moves as its type allows, so a
payload case added tomorrow is simulated without code. Values follow from seed and time alone.
"""

from __future__ import annotations

import math
import random
from typing import Any

from google.protobuf.message import Message

from router.tools.models import MODELS, Moment
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type

NESTING = 3
"""Messages within themselves are filled to this depth."""

NAMING = ("_id", "index")
"""How integer fields end that name a thing; they stand still."""

HEALTHY = ("OPERATING", "_OK", "NO_ERROR")
"""How the names of enum values end that say that all is well; a healthy rover stays there."""


class PayloadModel:
    """The values of one payload case over time. The same seed and times give the same messages."""

    def __init__(self, name: str, kind: MessageType, seed: int) -> None:
        self._name, self._kind, self._seed = name, kind, seed
        self._random = random.Random(f"{seed}/{name}")
        self._phases: dict[str, float] = {}

    def fill(self, message: Message, now: Moment) -> None:
        """Set every field of an empty message."""
        self._fill(message, self._kind, now, self._name, NESTING)

    def _fill(self, message: Any, kind: MessageType, now: Moment, path: str, depth: int) -> None:
        model = MODELS.get(kind.name)
        values = {} if model is None else model(now, self._noise)
        for field in kind.fields:
            if field.name in values:
                setattr(message, field.name, values[field.name])
            else:
                self._fill_field(message, field, now, f"{path}.{field.name}", depth)

    def _fill_field(self, message: Any, field: Field, now: Moment, path: str, depth: int) -> None:
        member = getattr(message, field.name)
        if isinstance(field.type, MessageType):
            member.SetInParent()
            if depth:
                self._fill(member, field.type, now, path, depth - 1)
        elif not isinstance(field.type, List):
            setattr(message, field.name, self._value(field.type, now, path))
        elif isinstance(field.type.element, MessageType):
            for index in range(_length(field.type) if depth else 0):
                self._fill(member.add(), field.type.element, now, f"{path}[{index}]", depth - 1)
        else:
            element = field.type.element
            member.extend(self._value(element, now, f"{path}[{index}]") for index in range(_length(field.type)))

    def _value(self, kind: Type, now: Moment, path: str) -> object:
        """A value of a scalar type: waves of half a minute, each path with a phase of its own."""
        wave = math.sin(now.t * math.tau / 30 + self._phase(path))
        if isinstance(kind, Float):
            return 10 * wave + self._noise(0.05)
        if isinstance(kind, Int) and path.endswith(NAMING):
            return int(self._phase(path))
        if isinstance(kind, Int):
            return round(50 * (wave + (0 if kind.signed else 1)))
        if isinstance(kind, Bool):
            return wave > 0
        if isinstance(kind, Enum):
            return _enum_value(kind, wave)
        text = f"{self._name} {now.t:.1f}"[: kind.bound if isinstance(kind, (String, Bytes)) else None]
        return text if isinstance(kind, String) else text.encode()

    def _phase(self, path: str) -> float:
        if path not in self._phases:
            self._phases[path] = random.Random(f"{self._seed}/{path}").uniform(0, math.tau)
        return self._phases[path]

    def _noise(self, deviation: float) -> float:
        return self._random.gauss(0.0, deviation)


def _length(kind: List) -> int:
    return kind.length if kind.length is not None else min(3, 3 if kind.bound is None else kind.bound)


def _enum_value(kind: Enum, wave: float) -> int:
    """The value that means health if the enum has one, else all of them in turn."""
    for name, number in kind.values:
        if name.endswith(HEALTHY):
            return number
    position = min(int((wave + 1) / 2 * len(kind.values)), len(kind.values) - 1)
    return kind.values[position][1]
