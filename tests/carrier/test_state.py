"""What a program keeps goes along to the next one by key."""

from __future__ import annotations

from router.carrier.state import State
from router.library import load


def test_what_has_the_same_key_is_the_same_object_in_the_next_program() -> None:
    first = State(load())
    limit = first.get_or_make(("limit", 1), object)
    assert first.get_or_make(("limit", 1), object) is limit
    gone = first.get_or_make(("limit", 2), object)
    then = State(load(), first)
    assert then.get_or_make(("limit", 1), object) is limit
    then.get_or_make(("limit", 3), object)
    then.forget_previous()
    assert then.get_or_make(("limit", 1), object) is limit
    assert then.get_or_make(("limit", 2), object) is not gone
