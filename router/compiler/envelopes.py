"""Checks which of several envelopes each listener and endpoint has, and that each envelope has its own lock file."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from router.errors import Code, Diagnostic, did_you_mean
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint, Listener
from router.types.protobuf import lock_path


def envelope_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for listeners and endpoints that name an unknown envelope, or none of several."""
    known = [name for name in table.envelopes if name]
    recipients = _recipients(table)
    places: list[Listener | Endpoint] = [*table.listeners.values(), *table.endpoints.values()]
    for place in places:
        if place.envelope is not None:
            name = place.envelope.value
            if name not in known and f"envelopes/{name}" not in table.broken:
                hint = did_you_mean(name, known) or "add it to 'envelopes'"
                yield Diagnostic(place.envelope.span, Code.UNKNOWN_ENVELOPE, f"there is no envelope '{name}'", hint)
        elif len(known) > 1 and (isinstance(place, Listener) or place.name in recipients):
            what = f"'{place.name}' does not say which envelope it has"
            yield Diagnostic(place.span, Code.MISSING_KEY, what, f"add `envelope: {' or '.join(known)}`")


def _recipients(table: RouteTable) -> Collection[str]:
    """Return the endpoints to which the router sends."""
    deadmen = [route.deadman for route in table.routes if route.deadman]
    replying = [route for route in table.routes if route.reply]
    return {
        *(to.endpoint.value for route in table.routes for to in route.destinations),
        *(to.value for deadman in deadmen for to in deadman.to),
        *(source.value for route in replying for source in route.sources),
        *(service.request.to.value for service in table.services.values()),
        *(call.source.source.value for call in table.called.values()),
    }


def shared_lock_findings(table: RouteTable) -> Iterator[Diagnostic]:
    """Yield findings for envelopes with the lock file of another one: a lock file records one envelope."""
    first: dict[Path, str] = {}
    for name, settings in table.envelopes.items():
        owner = first.setdefault(lock_path(settings.protos, settings.lock_file), name)
        if owner != name:
            message = f"the envelopes '{owner}' and '{name}' have the same lock file, which records only one"
            hint = f"write `lock: {name}.lock.json` in '{name}'"
            yield Diagnostic((settings.lock or settings.message).span, Code.BAD_VALUE, message, hint)
