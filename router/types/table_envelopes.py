"""The envelopes of a table: which of them a listener receives, an endpoint gets, and a payload case belongs to."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256

from router.errors import did_you_mean
from router.types.model import Enum
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema, Unroutable


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

    def unknown_case(self, name: str) -> tuple[str, str]:
        """Return message and hint for the name of a payload case that does not exist."""
        return f"{self.first.name} has no payload case '{name}'", did_you_mean(name, self.cases)

    @property
    def sha256(self) -> str:
        """A hash of all `.proto` files."""
        hashes = [schema.sha256 for schema in self.schemas]
        return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode()).hexdigest()
