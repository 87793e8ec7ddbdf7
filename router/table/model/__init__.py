"""The route table as typed, frozen data. Every value that a finding can point at keeps its span.

The fields declare the keys of the table (see `keys`); the docstrings of fields are what editors show (see
`grammar.keys`). The table itself is here, its parts are in the modules of this package. The compiler checks whether
payload cases, fields and ROS types exist.

Annotations are evaluated in all these modules: as strings, they would be compiled whenever a table is read.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from router.errors import Located, SourceSpan
from router.table.addresses import IPNetwork
from router.table.model.endpoints import Endpoint, Listener
from router.table.model.gateways import Gateway, IgnoredGateway
from router.table.model.routes import Route
from router.table.model.serial import SerialLine
from router.table.model.services import CalledService, Service
from router.table.model.settings import EnvelopeSettings, NodeSettings, RecordSettings, ServerSettings
from router.table.model.state import State


@dataclass(frozen=True, slots=True)
class Networks:
    """The networks that contain every address of the table. `span` is the key `networks`."""

    span: SourceSpan
    members: tuple[IPNetwork, ...]

    def __str__(self) -> str:
        """Return the text for findings, with the position of the key."""
        return f"the networks of {self.span.file}:{self.span.line} ({', '.join(map(str, self.members))})"


_SEVERAL = 2


@dataclass(frozen=True, slots=True)
class RouteTable:
    """A table after `extends` and variables. `files` are all files read, the table itself first.

    `routes_span` is the key `routes`; a table with only gateways has none and needs no envelope. `sha256` is over the
    bytes of `files` in order. `envelopes` are by name; the key `envelope` is one with the name "". `broken` names
    parts with findings, such as `endpoints/arm_board`, which were left out, so that their absence is not reported
    again. The valid rest of a broken route may still be in `routes`.
    """

    path: Path
    files: tuple[Path, ...]
    sha256: str
    envelopes: Mapping[str, EnvelopeSettings]
    node: NodeSettings
    http: ServerSettings | None
    listeners: Mapping[str, Listener]
    endpoints: Mapping[str, Endpoint]
    routes: tuple[Route, ...]
    routes_span: SourceSpan | None
    gateways: Mapping[str, Gateway] = field(default_factory=dict)
    ignored_gateways: Mapping[str, IgnoredGateway] = field(default_factory=dict)
    broken: frozenset[str] = frozenset()
    record: RecordSettings | None = None
    foxglove: ServerSettings | None = None
    reload_on_change: bool = False
    networks: Networks | None = None
    states: Mapping[str, State] = field(default_factory=dict)
    services: Mapping[str, Service] = field(default_factory=dict)
    called: Mapping[str, CalledService] = field(default_factory=dict)
    package: Located[str] | None = None

    @property
    def sockets(self) -> tuple[Listener, ...]:
        """The listeners that are UDP sockets."""
        return tuple(listener for listener in self.listeners.values() if listener.link is None)

    @property
    def links(self) -> tuple[Listener, ...]:
        """The listeners that are serial lines, TCP clients or TCP servers."""
        return tuple(listener for listener in self.listeners.values() if listener.link is not None)

    @property
    def lines(self) -> tuple[Listener, ...]:
        """The listeners that are serial lines."""
        return tuple(listener for listener in self.listeners.values() if isinstance(listener.link, SerialLine))

    @property
    def envelope_names(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """The name of the envelope of each listener, and of each endpoint; "" if it names none of several."""
        only = next(iter(self.envelopes), "") if len(self.envelopes) < _SEVERAL else ""
        return (
            {each.name: each.envelope.value if each.envelope else only for each in self.listeners.values()},
            {each.name: each.envelope.value if each.envelope else only for each in self.endpoints.values()},
        )
