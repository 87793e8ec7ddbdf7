"""Checks that the host names of endpoints are resolved on this computer."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from time import monotonic

from router.compiler.compiled_table import CompiledTable
from router.compiler.resolution import names, resolved, unresolved, why_unusable
from router.net.addresses import addresses_of
from router.threads import Thread
from router.tools.doctor_checks import CheckResult, fine, problem

PATIENCE = 5.0
"""Seconds for the resolver."""


class Names:
    """Resolves the host names of a table, all at once. `program` is the table with their addresses."""

    def __init__(self, program: CompiledTable, patience: float = PATIENCE) -> None:
        self._wanted = names(program)
        self._found: dict[str, list[str] | OSError] = {}
        self._lookups = {host: threading.Event() for host in {*self._wanted.values()}}
        for host, done in self._lookups.items():
            Thread(self._look_up, "name", (host, done)).start()
        until = monotonic() + patience
        for done in self._lookups.values():
            done.wait(max(0.0, until - monotonic()))
        found = {host: each for host, each in self._found.items() if isinstance(each, list)}
        self._unusable = {(host, each): why_unusable(program, host, each) for host in found for each in found[host]}
        usable = {host: [each for each in found[host] if not self._unusable[host, each]] for host in found}
        self.program = resolved(program, {host: each[0] for host, each in usable.items() if each})

    def _look_up(self, host: str, done: threading.Event) -> None:
        try:
            self._found[host] = addresses_of(host)
        except OSError as error:
            self._found[host] = error
        done.set()

    def results(self) -> Iterator[CheckResult]:
        missing = unresolved(self.program.table)
        for endpoint, host in self._wanted.items():
            if endpoint not in missing:
                address = self.program.table.endpoints[endpoint].address.value.host
                yield fine("names", f"{endpoint}: {host} is {address}")
                continue
            what = f"{endpoint}: {host} is not resolved: {self._why(host)}"
            yield problem("names", what, f"check it with `getent ahosts {host}`, or write the address")

    def _why(self, host: str) -> str:
        match self._found.get(host):
            case None:
                return f"the resolver does not answer within {PATIENCE:.0f} s"
            case OSError() as error:
                return error.strerror or str(error)
            case _:
                return ", ".join(why for (name, _), why in self._unusable.items() if name == host)
