"""Steps through a CDR message up to the last wanted field, and their layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from router.compiler.lowering.layout import Layout, Numbering, PlacedSection, ReadOperation
from router.compiler.lowering.names import TooLargeError
from router.compiler.lowering.offsets import HIGHEST, Offset
from router.compiler.lowering.operations import Slot
from router.compiler.lowering.sections import Section, Wanted, scalar_of, size_of
from router.declared import MOST_LOOPS, ReadKind
from router.errors import SourceSpan
from router.types.model import List, MessageType, String, Type


def cdr_layout(slots: Sequence[Slot], message: Section, elements: Sequence[Section], span: SourceSpan) -> Layout:
    """Number `slots` from 0, then those of the message, then those of list elements. Return the layout.

    Raises TooLargeError at `span` if the message nests more lists of messages than a routine can read.
    """
    maker = Numbering(slots)
    maker.number_sections([message, *elements])
    for index, root in enumerate((message, *elements)):
        first = len(maker.defaults)
        steps = _Steps(maker, span, Offset(HIGHEST) if root is message else Offset())
        steps.message(root.type, root)
        maker.sections[index] = PlacedSection(steps.without_trailing_skips(), first, len(maker.defaults) - first)
    return maker.made(is_cdr=True)


_MOST_UNROLLED = 64
"""Maximum length of an array of messages that is skipped without a loop."""


class _Steps:
    """Collects the steps through a message. Consecutive skips with known padding are merged."""

    def __init__(self, layout: Numbering, span: SourceSpan, offset: Offset, loops: int = 0) -> None:
        self.layout = layout
        self.span = span
        self.made: list[ReadOperation] = []
        self.offset = offset
        self.loops = loops
        self._skipped: tuple[int, int] | None = None  # an alignment, and a number of bytes
        self._wanted = 0  # steps up to the last wanted one

    def without_trailing_skips(self) -> tuple[ReadOperation, ...]:
        return tuple(self.made[: self._wanted])

    def message(self, declared: MessageType, section: Section | None) -> None:
        for member in declared.fields:
            wanted = section.wanted.get(member.name) if section is not None else None
            self._field(member.type, wanted)
        if not declared.fields:
            self._scalars(1, 1)  # rosidl gives it a byte

    def _field(self, declared: Type, wanted: Wanted | None) -> None:
        slot = wanted.value if wanted is not None else None
        match declared:
            case MessageType():
                self._inner(declared, wanted.section if wanted is not None else None, slot)
            case List():
                self._list(declared, slot)
            case String(wide=wide):
                if slot is not None:
                    self._add(ReadOperation(ReadKind.TEXT), slot)
                else:
                    self._add(ReadOperation(ReadKind.SEQUENCE, 4 if wide else 1), None)
                self.offset.lose(4 if wide else 1)
            case _ if slot is not None:
                self._flush()
                self._add(ReadOperation(ReadKind.SCALAR, type=scalar_of(declared)), slot)
                self.offset.advance(size_of(declared), size_of(declared))
            case _:
                self._scalars(size_of(declared), 1)

    def _inner(self, declared: MessageType, section: Section | None, slot: Slot | None) -> None:
        """Add steps for a nested message. If all of it is wanted, it is the only element of a list."""
        if slot is None:
            self.message(declared, section)
            return
        self._loop(ReadOperation(ReadKind.EACH, elements=1), slot, lambda steps: steps.message(declared, section))

    def _list(self, declared: List, slot: Slot | None) -> None:
        element, length = declared.element, declared.length
        if isinstance(element, (MessageType, String)):
            self._elements(element, length, slot)
            return
        size = size_of(element)
        if length is None:
            self._flush()
            self._add(ReadOperation(ReadKind.SEQUENCE, size, scalar_of(element)), slot)
            self.offset.lose(min(size, 4))  # an empty sequence ends after its length
        elif slot is None:
            self._scalars(size, length)
        else:
            self._flush()
            self._add(ReadOperation(ReadKind.ARRAY, size, scalar_of(element), elements=length), slot)
            self.offset.advance(size, size * length)

    def _elements(self, element: MessageType | String, length: int | None, slot: Slot | None) -> None:
        if slot is None and length is not None and length <= _MOST_UNROLLED:
            for _ in range(length):
                self._field(element, None)
            return
        loop = ReadOperation(ReadKind.EACH_SEQUENCE if length is None else ReadKind.EACH, elements=length or 0)
        if slot is not None and isinstance(element, String):
            texts = ReadOperation(ReadKind.TEXTS, slot=self.layout.number(slot))
            self._loop(loop, None, lambda steps: steps.made.append(texts))
            self._wanted = len(self.made)
        else:
            self._loop(loop, slot, lambda steps: steps._field(element, None))

    def _loop(self, loop: ReadOperation, slot: Slot | None, body: Callable[[_Steps], None]) -> None:
        if self.loops == MOST_LOOPS:
            message = f"this type nests more than {MOST_LOOPS} lists of messages"
            raise TooLargeError(self.span, message, "use another message type")
        self._add(loop, slot)
        inside = _Steps(self.layout, self.span, Offset(), self.loops + 1)
        body(inside)
        inside._flush()
        self.made += inside.made
        self.made.append(ReadOperation(ReadKind.AGAIN))
        if slot is not None or inside._wanted:
            self._wanted = len(self.made)
        self.offset.lose()

    def _add(self, step: ReadOperation, slot: Slot | None) -> None:
        self._flush()
        self.made.append(step if slot is None else step._replace(slot=self.layout.number(slot)))
        if slot is not None:
            self._wanted = len(self.made)

    def _scalars(self, size: int, count: int) -> None:
        """Skip scalars, merged with the bytes skipped before them if the padding is known."""
        if not count:
            return
        padding = self.offset.padding(size)
        if padding is None:
            self._flush()
            self._skipped = size, size * count
        else:
            alignment, skipped = self._skipped or (1, 0)
            self._skipped = alignment, skipped + padding + size * count
        self.offset.advance(size, size * count)

    def _flush(self) -> None:
        if self._skipped is None:
            return
        alignment, size = self._skipped
        self._skipped = None
        self.made.append(ReadOperation(ReadKind.SKIP, alignment, elements=size // alignment))
        if size % alignment:
            self.made.append(ReadOperation(ReadKind.SKIP, 1, elements=size % alignment))
