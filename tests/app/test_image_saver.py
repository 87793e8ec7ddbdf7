"""Which image is stored at the end of several reloads."""

from __future__ import annotations

from threading import Event

import pytest

from router.app.image_saver import ImageSaver
from router.image.image import Image
from router.inputs import Inputs
from router.startup_image import store

IMAGE = Image()


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
    saver = ImageSaver(Inputs(), first, first.plain())
    saver.save(IMAGE, first)  # as after a head start
    assert has_ended.wait(20)
    has_ended.clear()
    for read in (second, first):
        saver.save(IMAGE, read)
        assert is_writing.wait(20)
    may_end.set()
    saver.save(IMAGE, first)
    assert has_ended.wait(20)
    assert written == [second.plain(), first.plain()]
