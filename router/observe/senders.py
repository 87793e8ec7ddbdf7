"""Who sends messages that no route accepts from them, and in whose place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import cached_property
from typing import TYPE_CHECKING

from router.compiler.metrics import Mismatch
from router.table.addresses import parse_address
from router.table.model.routes import ANY

if TYPE_CHECKING:
    from router.compiler.compiled_table import CompiledTable

MOST_NAMED = 3
"""Maximum routes or senders that a text names."""


class Senders:
    """The senders of `mismatches`, judged by a program. `learned` are the learned addresses, by endpoint."""

    def __init__(self, program: CompiledTable, mismatches: AbstractSet[Mismatch], learned: Mapping[str, str]) -> None:
        self._program = program
        self._learned = learned
        lines = {line.name: line.address.value.host for line in program.table.lines}  # the router sees no host there
        self._mismatches = sorted(each._replace(host=lines.get(each.listener, each.host)) for each in mismatches)

    @cached_property
    def sources(self) -> Mapping[str, set[str]]:
        """The endpoints that each route accepts messages from."""
        return {route.name: {source.value for source in route.sources} for route in self._program.table.routes}

    def expected(self, mismatch: Mismatch) -> list[str]:
        """Return the endpoints that routes accept this payload case from."""
        routes = (route for route in self._program.table.routes if route.case.value == mismatch.payload_case)
        return list(dict.fromkeys(name for route in routes for name in sorted(self.sources[route.name] - {ANY})))

    def is_learned(self, endpoint: str) -> bool:
        """Whether the address of the endpoint is learned, perhaps not yet."""
        return self._program.table.endpoints[endpoint].address.value.is_learned

    def host(self, endpoint: str) -> str:
        """Return the host of an endpoint; "" before it is learned."""
        if self.is_learned(endpoint):
            learned = self._learned.get(endpoint)
            return parse_address(learned).host if learned is not None else ""
        return self._program.table.endpoints[endpoint].address.value.host

    def in_place_of(self, endpoint: str) -> str | None:
        """Return another host that sends messages expected only from this endpoint."""
        hosts = (each.host for each in self._mismatches if self.expected(each) == [endpoint])
        return next((host for host in hosts if host != self.host(endpoint)), None)

    def of(self, payload_case: str) -> list[str]:
        """Return who has recently sent messages of this case, which no route accepts from them."""
        return [self._name_of(each.host) for each in self._mismatches if each.payload_case == payload_case]

    def mismatched(self, listener: str) -> tuple[str, tuple[str, ...]]:
        """Describe who sends messages expected from others to a listener; also return the routes that reject them."""
        found = [each for each in self._mismatches if each.listener == listener and self.expected(each)]
        sentences: dict[str, None] = {}
        for each in found:
            who = self._name_of(each.host)
            expected = self.expected(each)
            if each.host in map(self.host, expected):
                than = "before" if any(map(self.is_learned, expected)) else "the table says"
                sentences[f"{who} uses another port or listener than {than}"] = None
            else:
                others = " or ".join(f"{name} ({self.host(name) or 'not learned yet'})" for name in expected)
                sentences[f"{who} sends messages expected from {others}"] = None
        cases = {each.payload_case for each in found}
        routes = tuple(route.name for route in self._program.table.routes if route.case.value in cases)
        return few([*sentences]), routes

    def unknown(self, listener: str) -> str:
        """Describe who sends payloads to a listener that its envelope does not have."""
        known = self._program.envelopes.numbers
        found = [each for each in self._mismatches if each.listener == listener and each.payload_case not in known]
        return few([f"{self._name_of(each.host)} sends {each.payload_case}" for each in found])

    def _name_of(self, host: str) -> str:
        """Return the host with the name of its endpoint, if it has one."""
        found = (name for name in self._program.table.endpoints if self.host(name) == host)
        return next((f"{name} ({host})" for name in found), host)


def few(texts: Sequence[str]) -> str:
    """Return the first texts, and how many follow."""
    rest = len(texts) - MOST_NAMED
    return "; ".join(texts[:MOST_NAMED]) + (f"; and {rest} more" if rest > 0 else "")
