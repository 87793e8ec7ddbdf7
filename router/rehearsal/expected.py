"""`expect:` of a test as data: what is sent, published, dropped and rejected, by the names of the table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from router.compiler.metrics import DROP_REASONS, REJECT_REASONS
from router.errors import Code, Located, SourceSpan, did_you_mean
from router.rehearsal.matching import MessageMatch
from router.rehearsal.model import Content, Counted, Expected, Item, Message, Payload, Unchanged, Whatever
from router.rehearsal.names import Names, unsound
from router.rehearsal.values import ANY, FieldReader
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.types.model import MessageType

UNCHANGED = "unchanged"
_MOST = 100_000


class ExpectedReader:
    def __init__(self, names: Names) -> None:
        self._names = names
        self._fields = FieldReader(names.enums)
        self._given = FieldReader(names.enums, given=True)

    def expected(self, span: SourceSpan, node: Node, given: Node | None) -> Expected:
        """`given` is what the step is given, which 'unchanged' refers to. Raises InvalidValueError."""
        if isinstance(node, ScalarNode):
            return Expected(span, anything=node.text == ANY)
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        route, rejected, filtered = (node.entries.get(key) for key in ("route", "rejected", "filtered"))
        return Expected(
            span=span,
            sent=self._sent(node.get("sent"), given),
            published=self._published(node.get("published"), given),
            dropped=self._dropped(node.get("dropped")),
            rejected=Located(_counted(rejected.value, REJECT_REASONS), rejected.key.span) if rejected else None,
            filtered=Located(self._filtered(filtered.value), filtered.key.span) if filtered else None,
            route=Located(self._names.route(*_name(route.value)), route.value.span) if route else None,
        )

    # datagrams

    def _sent(self, node: Node | None, given: Node | None) -> Mapping[str, tuple[Item, ...]]:
        if not isinstance(node, MappingNode):
            named = [_name(item) for item in _listed(node)]
            _each_once(named)
            return {self._names.endpoint(name, span).name: (_unchanged(span, given),) for name, span in named}
        return {
            self._names.endpoint(name, entry.key.span).name: tuple(
                item for one in _listed(entry.value) for item in self._datagrams(one, given)
            )
            for name, entry in node.entries.items()
        }

    def _datagrams(self, node: Node, given: Node | None) -> Sequence[Item]:
        if isinstance(node, ScalarNode):
            return [_delivery(node, given)]
        if not isinstance(node, MappingNode):
            raise unsound(node.span, Code.WRONG_TYPE, "a list within a list is no datagram")
        times = _times(node)
        content = {name: entry for name, entry in node.entries.items() if name != "times"}
        if not content:
            return [_unchanged(node.span, given)] * times
        if len(content) > 1:
            second = list(content.values())[1].key
            raise unsound(
                second.span, Code.BAD_VALUE, "a datagram has one payload", "write a list of several datagrams"
            )
        ((name, entry),) = content.items()
        made = _bytes(entry.value) if name == "hex" else self._payload(name, entry.key.span, entry.value, given)
        return [Item(made, entry.key.span)] * times

    def _payload(self, name: str, span: SourceSpan, node: Node, given: Node | None) -> Payload:
        case = self._names.case(name, span)
        return Payload(case, None if _is(node, ANY) else self._content(case.type, node, given))

    def _content(self, kind: MessageType, node: Node, given: Node | None) -> MessageMatch:
        """Fields as they are written here, or as they were given."""
        if not _is(node, UNCHANGED):
            return self._fields.message(kind, node)
        if not isinstance(given, MappingNode) or "hex" in given.entries:
            raise unsound(node.span, Code.BAD_VALUE, "no fields were given in this step that could be unchanged")
        fields = given.get("fields") or given.get("message")
        return self._given.message(kind, fields) if fields else MessageMatch({}, node.span)

    # messages

    def _published(self, node: Node | None, given: Node | None) -> Mapping[str, tuple[Item, ...]]:
        found: dict[str, tuple[Item, ...]] = {}
        for name, entry in node.entries.items() if isinstance(node, MappingNode) else ():
            kind = self._names.published(name, entry.key.span)
            listed = _listed(entry.value)
            found[name] = tuple(item for one in listed for item in self._messages(kind, entry.key.span, one, given))
        return found

    def _messages(self, kind: MessageType, span: SourceSpan, node: Node, given: Node | None) -> Sequence[Item]:
        times = 1
        if isinstance(node, MappingNode) and set(node.entries) == {"message", "times"}:
            times = _times(node)
            node = node.entries["message"].value
        if _is(node, ANY):
            return [Item(Whatever(), span)] * times
        return [Item(Message(kind, self._content(kind, node, given)), span)] * times

    # what is not delivered

    def _dropped(self, node: Node | None) -> Mapping[str, Located[Counted]]:
        entries = node.entries.items() if isinstance(node, MappingNode) else ()
        return {
            self._names.target(name, entry.key.span): Located(_counted(entry.value, DROP_REASONS), entry.key.span)
            for name, entry in entries
        }

    def _filtered(self, node: Node) -> Counted:
        if isinstance(node, MappingNode):
            counts = {name: _count(entry.value) for name, entry in node.entries.items()}
            return {self._names.target(name, node.entries[name].key.span): count for name, count in counts.items()}
        return Counter(self._names.target(*_name(item)) for item in _listed(node))


def _counted(node: Node, reasons: Iterable[str]) -> Counted:
    """A reason, a list of them, or how many of each."""
    known = list(reasons)
    named = [_name(item) for item in _listed(node)] if not isinstance(node, MappingNode) else [
        (name, entry.key.span) for name, entry in node.entries.items()
    ]  # fmt: skip
    for name, span in named:
        if name not in known:
            raise unsound(span, Code.BAD_VALUE, f"there is no reason '{name}'", did_you_mean(name, known))
    if isinstance(node, MappingNode):
        return {name: _count(entry.value) for name, entry in node.entries.items()}
    return Counter(name for name, _ in named)


def _delivery(node: ScalarNode, given: Node | None) -> Item:
    makers: Mapping[str, Callable[[], Item]] = {
        UNCHANGED: lambda: _unchanged(node.span, given),
        ANY: lambda: Item(Whatever(), node.span),
    }
    if node.text not in makers:
        message = f"'{node.text}' is no datagram"
        raise unsound(node.span, Code.BAD_VALUE, message, f"write {UNCHANGED}, {ANY}, or {{CASE: {{FIELD: value}}}}")
    return makers[node.text]()


def _unchanged(span: SourceSpan, given: Node | None) -> Item:
    if not isinstance(given, MappingNode) or "topic" in given.entries:
        message = "no datagram was given in this step that could be unchanged"
        raise unsound(span, Code.BAD_VALUE, message, "write {ENDPOINT: {CASE: {FIELD: value}}}")
    return Item(Unchanged(), span)


def _bytes(node: Node) -> Content:
    try:
        return bytes.fromhex(_name(node)[0])
    except ValueError:
        raise unsound(node.span, Code.BAD_VALUE, "'hex' takes bytes in quotes, such as '0a 05'") from None


def _times(node: MappingNode) -> int:
    times = node.get("times")
    return _count(times) if times else 1


def _count(node: Node) -> int:
    value = node.value if isinstance(node, ScalarNode) else None
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _MOST:
        raise unsound(node.span, Code.BAD_VALUE, f"how often is a whole number from 1 to {_MOST}")
    return value


def _each_once(named: Sequence[tuple[str, SourceSpan]]) -> None:
    names = [name for name, _ in named]
    for index, (name, span) in enumerate(named):
        if name in names[:index]:
            hint = f"where it gets the datagram twice, write {{{name}: {{times: 2}}}}"
            raise unsound(span, Code.BAD_VALUE, f"'{name}' is named twice", hint)


def _name(node: Node) -> tuple[str, SourceSpan]:
    if not isinstance(node, ScalarNode):
        raise unsound(node.span, Code.WRONG_TYPE, "this must be a name")
    return node.text, node.span


def _listed(node: Node | None) -> Sequence[Node]:
    """One, or a list of them; of nothing, none."""
    if node is None:
        return ()
    return node.items if isinstance(node, SequenceNode) else (node,)


def _is(node: Node, word: str) -> bool:
    return isinstance(node, ScalarNode) and node.text == word
