"""The values of the states of a running table, and what set them, for the status page and `router top`.

Imports neither compiler nor protobuf, so that `router status` starts fast.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from router.compiler.compiled_table import CompiledTable, StatePlan
    from router.observe.snapshot import Snapshot


@dataclass(frozen=True, slots=True)
class StateReading:
    """The present value of a state, as a table writes it, and who last set it, `age` seconds ago; None for nobody.

    `is_valid`: that value has not expired, so it is the present one.
    """

    name: str
    value: str
    setter: str | None
    age: float | None
    is_valid: bool

    @property
    def origin(self) -> str:
        """What set it, in words; `last set` if that has expired."""
        from router.values.printing import age_text

        if self.age is None:
            return "never set"
        return f"{'' if self.is_valid else 'last '}set {age_text(self.age)} ago by {self.setter}"


def state_readings(program: CompiledTable, now: Snapshot) -> Iterator[StateReading]:
    """Yield the states of a program, in the order of its table."""
    for state in program.states:
        ages = {setter: age for (setter,), age in now.of("state_set_seconds", state.name).items()}
        setter = min(ages, key=ages.__getitem__, default=None)
        age = ages[setter] if setter is not None else None
        is_valid = age is not None and (state.valid_for is None or age <= state.valid_for / 1e9)
        yield StateReading(state.name, present_value(state, now), setter, age, is_valid)


def present_value(state: StatePlan, now: Snapshot) -> str:
    """Return the present value of a state as a table writes it."""
    if state.is_text:
        return state.shown(next((text for (text,) in now.of("state_text", state.name)), state.initial))
    return state.shown(int(now.counts("state")[(state.name,)]))
