"""Shell completion of words from a table: payload cases, fields, endpoints, listeners, gateways, services, topics.

Most are taken as they are written, without a check of the table. A table that cannot be read gives no words and no
message: the verb reports the problem.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from router import inputs
from router.cli.tool_options import table_if_any
from router.errors import RouterError, TableError

if TYPE_CHECKING:
    from router.datagrams import Wire
    from router.table.model import RouteTable
    from router.types.model import Field, MessageType

Words = Callable[[argparse.Namespace, str], Iterable[str]]
"""A function from the arguments before a word, and the beginning of that word, to its possible completions."""


def completes(action: argparse.Action, words: Words) -> None:
    """Make the shell complete an argument with `words`."""

    def completer(prefix: str, parsed_args: argparse.Namespace, **_: object) -> list[str]:
        completions: list[str] = []
        with suppress(RouterError, OSError, LookupError):
            completions.extend(words(parsed_args, prefix))
        return list(dict.fromkeys(completions))

    action.completer = completer  # type: ignore[attr-defined]  # where argcomplete looks


def routed(args: argparse.Namespace, _: str = "") -> Iterator[str]:
    """Yield the payload cases that the table routes, its services, and its gateways."""
    yield from _names(args, "routes", "services", "gateways")


def cases(args: argparse.Namespace, _: str = "") -> Iterable[str]:
    """Return the payload cases of the envelopes."""
    return _wire(args).envelopes.cases


def endpoints(args: argparse.Namespace, _: str = "") -> Iterable[str]:
    return _names(args, "endpoints")


def senders(args: argparse.Namespace, _: str = "") -> Iterator[str]:
    """Yield the endpoints that may send messages."""
    from router.table.model.endpoints import EndpointKind

    if table := _table(args):
        yield from (endpoint.name for endpoint in table.endpoints.values() if endpoint.kind is not EndpointKind.TOOL)


def places(args: argparse.Namespace, _: str = "") -> Iterable[str]:
    """Return the places to send datagrams to: listeners and endpoints."""
    return _names(args, "listen", "endpoints")


def silences(args: argparse.Namespace, _: str = "") -> Iterator[str]:
    """Yield each endpoint and route with a colon, to be followed by seconds."""
    yield from (f"{name}:" for name in _names(args, "endpoints", "routes"))


def obedience(args: argparse.Namespace, prefix: str) -> Iterator[str]:
    """Yield each endpoint with a colon, and after it payload cases, separated by commas."""
    end = max(prefix.rfind(":"), prefix.rfind(",")) + 1
    names = _names(args, "routes") if end else (f"{name}:" for name in _names(args, "endpoints"))
    yield from (prefix[:end] + name for name in names)


def topics(args: argparse.Namespace, _: str = "") -> Iterator[str]:
    """Yield the topics of routes and gateways by their full names, as gateways send them."""
    from router.compiler.topics import resolved

    if table := _table(args):
        yield from (resolved(name, table.node) for name in _topics(table))


def listened(args: argparse.Namespace, prefix: str) -> Iterable[str]:
    """Return the places of `router listen`: the schemes, then names from the table for `envelope://` and `topic://`."""
    scheme, separator, _ = prefix.partition("://")
    if not separator:
        return [f"{name}://" for name in ("envelope", "topic", "udp", "tcp", "ws", "zenoh")]
    names: Iterable[str] = ()
    if scheme == "envelope":
        names = places(args)
    elif scheme == "topic" and (table := _table(args)):
        names = _topics(table)
    return [f"{scheme}://{name}" for name in names]


def fields(args: argparse.Namespace, prefix: str) -> Iterable[str]:
    """Return `accel_x=`, `bbox.x=` or `state=NAME` for the payload case given before."""
    case = getattr(args, "case", None) or args.names[0]
    return _assignments(_wire(args).envelopes.cases[case].type, prefix)


def services(args: argparse.Namespace, _: str = "") -> Iterable[str]:
    """Return the services of the table."""
    return _names(args, "services")


def request_fields(args: argparse.Namespace, prefix: str) -> Iterable[str]:
    """Return words as `fields` does, for the request of the service named before."""
    from router.tools.services import halves, services_of

    table = _table(args)
    type_name = args.type or (services_of(table)[args.service].type_name if table is not None else "")
    return _assignments(halves(type_name)[0], prefix)


def _assignments(kind: MessageType, prefix: str) -> Iterator[str]:
    from router.types.model import Bool, Enum, MessageType

    path, has_value, _ = prefix.partition("=")
    *parents, last = path.split(".")
    before = "".join(f"{parent}." for parent in parents)
    for parent in parents:
        inner = _element(_field(kind, parent))
        if not isinstance(inner, MessageType):
            return
        kind = inner
    if not has_value:
        for field in kind.fields:
            yield f"{before}{field.name}{'.' if isinstance(_element(field), MessageType) else '='}"
        return
    element = _element(_field(kind, last))
    values = [name for name, _ in element.values] if isinstance(element, Enum) else []
    yield from (f"{path}={name}" for name in (("true", "false") if isinstance(element, Bool) else values))


def _field(kind: MessageType, step: str) -> Field:
    """Return a field. Raises LookupError if it does not exist."""
    name = step.partition("[")[0]
    return {field.name: field for field in kind.fields}[name]


def _element(field: Field) -> object:
    from router.types.model import List

    return field.type.element if isinstance(field.type, List) else field.type


def _topics(table: RouteTable) -> Iterator[str]:
    yield from (topic.topic.value for route in table.routes for topic in route.all_topics)
    yield from (inbound.topic.topic.value for gateway in table.gateways.values() for inbound in gateway.inbound)


def _names(args: argparse.Namespace, *keys: str) -> Iterator[str]:
    """Yield the keys in these sections of the table and of the tables that it extends, valid or not."""
    from router.table.extends import load_chain
    from router.table.nodes import MappingNode

    if (path := table_if_any(args)) is not None:
        parts = map(load_chain(path, inputs.ENVIRONMENT, [], []).get, keys)
        yield from (name for part in parts if isinstance(part, MappingNode) for name in part.entries)


def _table(args: argparse.Namespace) -> RouteTable | None:
    """Return the valid part of the table named before, or of the default table."""
    from router.table import load_table

    path: Path | None = table_if_any(args)
    return load_table(path)[0] if path is not None else None


def _wire(args: argparse.Namespace) -> Wire:
    """Load the messages, also from a table with errors elsewhere.

    Raises TableError, UsageError or FileNotFoundError.
    """
    from router.assets import asset
    from router.datagrams import wire_of_protos, wire_of_table
    from router.table import load_table

    protos: Path | None = getattr(args, "protos", None)
    if protos is not None or (path := table_if_any(args)) is None:
        return wire_of_protos(protos or asset("protos"))
    table, findings = load_table(path)
    if table is None:
        raise TableError(findings)
    return wire_of_table(table)
