"""The envelopes of a table: which of them a listener receives, an endpoint gets, and a payload case belongs to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256

from router.errors import did_you_mean
from router.types.model import Enum
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema, Unroutable


def told_apart(by_name: Mapping[str, Envelope]) -> Mapping[str, Envelope]:
    """Return the envelopes with the name of the envelope before each case that several of them have."""
    return {label: _named(by_name[label], label, names) for label, names in _names(by_name).items()}


def written_alike(by_name: Mapping[str, Envelope]) -> tuple[str, str] | None:
    """Return an envelope with a case that would be written as another one is, and that text; None if all differ."""
    found: set[str] = set()
    for label, names in _names(by_name).items():
        for name in names.values():
            if name in found:
                return label, name
            found.add(name)
    return None


def _names(by_name: Mapping[str, Envelope]) -> Mapping[str, Mapping[str, str]]:
    """Return how the cases of each envelope are written in a table, by their names."""
    holders = Counter(case for envelope in by_name.values() for case in envelope.numbers)
    return {
        label: {name: f"{label}.{name}" if holders[name] > 1 else name for name in envelope.numbers}
        for label, envelope in by_name.items()
    }


def _named(envelope: Envelope, label: str, names: Mapping[str, str]) -> Envelope:
    """Return the envelope with its name, and the names of its cases, in a table."""
    cases = {names[name]: replace(case, name=names[name], envelope=label) for name, case in envelope.cases.items()}
    unroutable = {names[name]: member for name, member in envelope.unroutable.items()}
    parts = frozenset(names[name] for name in envelope.parts if name in names)
    return replace(envelope, cases=cases, unroutable=unroutable, parts=parts, label=label)


@dataclass(frozen=True)
class Envelopes:
    """The envelopes of a table by name; a table with `envelope` has a single one, whose name is "".

    `listeners` and `endpoints` have the name of the envelope of each. Names of payload cases are unique.
    """

    by_name: Mapping[str, Envelope]
    listeners: Mapping[str, str] = field(default_factory=dict)
    endpoints: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def first(self) -> Envelope:
        """The only envelope of most tables."""
        return next(iter(self.by_name.values()))

    @property
    def title(self) -> str:
        """The messages of all envelopes."""
        return " or ".join(envelope.name for envelope in self.by_name.values())

    @property
    def schemas(self) -> Sequence[ProtoSchema]:
        """What the `.proto` files of each envelope declare."""
        return [envelope.schema for envelope in self.by_name.values()]

    @cached_property
    def cases(self) -> Mapping[str, PayloadCase]:
        """The payload cases of all envelopes, by name."""
        return {name: case for envelope in self.by_name.values() for name, case in envelope.cases.items()}

    @cached_property
    def unroutable(self) -> Mapping[str, Unroutable]:
        """The cases of all envelopes that no route can take, by name."""
        return {name: case for envelope in self.by_name.values() for name, case in envelope.unroutable.items()}

    @cached_property
    def parts(self) -> Collection[str]:
        """The cases that are also parts of other messages, and therefore need no route."""
        return frozenset(name for envelope in self.by_name.values() for name in envelope.parts)

    @cached_property
    def enums(self) -> Sequence[Enum]:
        """All enums that the `.proto` files declare."""
        return tuple(enum for schema in self.schemas for enum in schema.enums.values())

    @cached_property
    def numbers(self) -> Mapping[str, int]:
        """The numbers of all cases within their envelopes, also of those that no route can take."""
        return {name: number for envelope in self.by_name.values() for name, number in envelope.numbers.items()}

    @cached_property
    def _holders(self) -> Mapping[str, Envelope]:
        return {name: envelope for envelope in self.by_name.values() for name in envelope.numbers}

    def at(self, listener: str) -> Envelope:
        """Return the envelope that a listener receives; the first one if there is no such listener."""
        return self.by_name.get(self.listeners.get(listener, ""), self.first)

    def to(self, endpoint: str) -> Envelope:
        """Return the envelope that an endpoint gets; the first one if there is no such endpoint."""
        return self.by_name.get(self.endpoints.get(endpoint, ""), self.first)

    def of(self, case: str) -> Envelope:
        """Return the envelope that holds a payload case, also one that no route can take. Raises KeyError."""
        return self._holders[case]

    def held(self, case: PayloadCase, endpoint: str) -> Sequence[PayloadCase]:
        """Return the payload cases as which an endpoint may get a payload of `case`: those of its type, if it gets
        another envelope.
        """
        around = self.to(endpoint)
        return [case] if around is self.of(case.name) else around.holding(case)

    def unknown_case(self, name: str) -> tuple[str, str]:
        """Return message and hint for the name of a payload case that does not exist."""
        if several := [each for label in self.by_name if (each := f"{label}.{name}") in self.numbers]:
            return f"several envelopes have the payload case '{name}'", f"write {' or '.join(several)}"
        label, _, case = name.partition(".")
        if label in self.by_name and case in self.by_name[label].numbers:
            return f"'{label}' is the only envelope with the payload case '{case}'", f"write '{case}'"
        return f"{self.title} has no payload case '{name}'", did_you_mean(name, self.cases)

    @property
    def sha256(self) -> str:
        """A hash of all `.proto` files."""
        hashes = [schema.sha256 for schema in self.schemas]
        return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode()).hexdigest()
