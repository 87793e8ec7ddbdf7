"""What a program keeps goes along to the next one by key."""

from __future__ import annotations

from router.carrier.library import load
from router.carrier.state import State


def test_what_has_the_same_key_is_the_same_object_in_the_next_program() -> None:
    first = State(load())
    limit = first.keep(("limit", 1), object)
    assert first.keep(("limit", 1), object) is limit
    gone = first.keep(("limit", 2), object)
    then = State(load(), first)
    assert then.keep(("limit", 1), object) is limit
    then.keep(("limit", 3), object)
    then.forget_previous()
    assert then.keep(("limit", 1), object) is limit
    assert then.keep(("limit", 2), object) is not gone
