"""The meaning of names in the expressions of a target: messages, and values in slots."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Union

from router.compiler.lowering.operations import Flag, Slot
from router.compiler.lowering.sections import Section
from router.declared import MOST_TEXT
from router.errors import Code, FindingError, SourceSpan

Meaning = Union[Slot, Section]


class TooLargeError(FindingError):
    """A part of the table exceeds the limits of a routine."""

    def __init__(self, span: SourceSpan, message: str, hint: str) -> None:
        super().__init__(span, Code.TOO_LARGE, message, hint)


@dataclass(slots=True)
class Loop:
    """A loop whose body is being lowered, with the variables of its elements.

    `flags` are cleared before the loop. Each tells whether a loop invariant has been computed.
    """

    variables: frozenset[str]
    flags: list[Flag] = field(default_factory=list)


@dataclass(slots=True)
class Names:
    """The `variables` by name. Temporaries and elements are numbered with them in one layout.

    `elements` are the sections that elements of lists are read into, `joined` is the number of bytes of joined text.
    """

    variables: dict[str, Meaning]
    temporaries: list[Slot] = field(default_factory=list)
    elements: list[Section] = field(default_factory=list)
    joined: int = 0
    loops: list[Loop] = field(default_factory=list)
    """The loops around the current node, outermost first."""

    def temporary(self) -> Slot:
        self.temporaries.append(Slot(0))
        return self.temporaries[-1]

    def flag(self, loop: Loop) -> Flag:
        """Return a new flag that is cleared before a loop."""
        flag = Flag(0)
        self.temporaries.append(flag)
        loop.flags.append(flag)
        return flag

    def element(self, like: Section) -> Section:
        """Return a new section for an element of a list, with the type and path of `like`."""
        self.elements.append(replace(like, wanted={}))
        return self.elements[-1]

    def count_text(self, most: int, span: SourceSpan) -> None:
        """Count bytes of joined text. Raises TooLargeError if there is no room for them."""
        self.joined += most
        if self.joined > MOST_TEXT:
            message = f"the text joined here can reach {self.joined} bytes; the limit is {MOST_TEXT}"
            raise TooLargeError(span, message, "join fewer fields")
