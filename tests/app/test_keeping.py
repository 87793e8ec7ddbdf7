"""Which program is kept at the end of several reloads."""

from __future__ import annotations

from threading import Event
from typing import cast

import pytest

from router.app.keeping import Keeper
from router.compiler.program import Program
from router.inputs import Inputs
from router.kept import store
from router.library import library

PROGRAM = cast("Program", object())


def reading(value: str) -> Inputs:
    inputs = Inputs()
    inputs.note("variable", "NAME", value)
    return inputs


def test_a_table_that_is_restored_while_the_other_is_being_written_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = reading("first"), reading("second")
    written: list[object] = []
    is_writing, may_end, has_ended = Event(), Event(), Event()

    def write(read: object, *_: object) -> None:
        is_writing.set()
        assert may_end.wait(20)
        written.append(read)

    monkeypatch.setattr(store, "write", write)
    monkeypatch.setattr(store, "clear_tries", has_ended.set)
    monkeypatch.setattr("router.carrier.image.image_of", lambda *_: ((), b""))
    keeper = Keeper(library(), Inputs(), first, first.plain())
    keeper.keep(lambda: PROGRAM, first)  # as after a head start
    assert has_ended.wait(20)
    has_ended.clear()
    for read in (second, first):
        keeper.keep(lambda: PROGRAM, read)
        assert is_writing.wait(20)
    may_end.set()
    keeper.keep(lambda: PROGRAM, first)
    assert has_ended.wait(20)
    assert written == [second.plain(), first.plain()]
