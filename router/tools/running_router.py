"""The HTTP client of a running router: its health and metrics, commands to it, and its tap."""

from __future__ import annotations

import errno
import http.client
import json
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from email.message import Message
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlencode, urlsplit

from router.errors import TransportError, UsageError
from router.hosts import with_port
from router.observe.problems import Kind, Problem
from router.observe.services import ServiceReading
from router.observe.states import StateReading

if TYPE_CHECKING:
    from router.observe.snapshot import Snapshot
    from router.observe.tap import Lost
    from router.recording.mirror import Action, MirroredDatagram
    from router.table.addresses import Address
    from router.table.model import RouteTable

PATIENCE = 5.0
"""Seconds; a router answers immediately, and sends at least once per second in a tap."""

PIECE = 1 << 18


class Answer(NamedTuple):
    """The JSON object of an answer; `ok`: the command was executed."""

    ok: bool
    body: dict[str, Any]


class Health(NamedTuple):
    """What is wrong with a router, which table it runs (file name and SHA-256), and the datagrams it has received.

    `states` and `services` are those of the table, `learned` the learned addresses, by endpoint.
    """

    name: str
    table_sha256: str
    received: int
    states: tuple[StateReading, ...]
    services: tuple[ServiceReading, ...]
    learned: Mapping[str, str]
    problems: tuple[Problem, ...]

    @property
    def is_degraded(self) -> bool:
        return any(problem.kind.level.is_fault for problem in self.problems)


def url_of(table: RouteTable) -> str:
    """Return the URL of the router that runs a table. Raises UsageError if the table has no `http.address`."""
    if table.http is None:
        raise UsageError(f"{table.path} has no 'http.address', so a running router cannot be reached")
    return url_at(table.http.address.value)


def url_at(address: Address) -> str:
    """Return the URL of a router with this `http.address`."""
    from router.tools.udp import reachable

    return f"http://{reachable(address)}"


def post(url: str, path: str, patience: float = PATIENCE) -> Answer:
    """Send a command to a running router of this computer. Raises UsageError or TransportError if none executes it."""
    with closing(_control(url, patience)) as connection:
        response = _asked(connection, url, "POST", path)
        text = _read(response, url)
        try:
            body = json.loads(text)
        except ValueError:
            raise TransportError(f"{url}{path}: {response.status} {_first_line(text)}") from None
        return Answer(response.status == http.client.OK, body)


def metrics(url: str) -> Snapshot:
    """Return the metrics of a running router, and when they were read (`at`: s, boot clock).

    Raises TransportError if nothing answers, or something other than a router.
    """
    from router.observe.snapshot import COLLECTED_AT, parse_metrics

    text, headers = _got(url, "/metrics")
    try:
        at = float(headers.get(COLLECTED_AT) or time.monotonic())
        snapshot = parse_metrics(text.decode(errors="replace"), at)
    except (ValueError, KeyError) as error:
        raise TransportError(f"what answers at {url}/metrics is not a router") from error
    if not snapshot.values:
        raise TransportError(f"what answers at {url}/metrics is not a router: it does not have a router's metrics")
    return snapshot


def health(url: str) -> Health:
    """Return what is wrong with a running router. Raises TransportError as `metrics` does."""
    text, _ = _got(url, "/health.json")
    try:
        answer = json.loads(text)
        states = tuple(StateReading(**state) for state in answer["states"])
        services = tuple(ServiceReading(**service) for service in answer["services"])
        problems = tuple(map(Problem.of, answer["problems"]))
        learned = {name: str(address) for name, address in answer["learned"].items()}
        return Health(answer["name"], answer["table"], answer["received"], states, services, learned, problems)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise TransportError(f"what answers at {url}/health.json is not a router of this version") from error


def down(url: str, error: TransportError) -> Problem:
    """Return the problem that no router answers."""
    problem = Problem(Kind.ROUTER_DOWN, {"instance": url})
    text = str(error)
    return problem._replace(more=text.removeprefix(problem.words) if text.startswith(problem.words) else f": {text}")


@contextmanager
def tap(
    url: str, cases: Sequence[str] = (), sources: Sequence[str] = (), only: str | None = None
) -> Iterator[Iterator[list[MirroredDatagram | Action | Lost]]]:
    """Open a tap of the datagrams that a running router receives, and of its actions.

    Only datagrams with these payload cases, from these endpoints (empty: all) and with this decision (`only`: one of
    DECISIONS; None: both). They arrive in batches; while there is nothing, an empty batch arrives each second.
    Datagrams without a known payload case are always included; actions unless `sources` or `only` is given. Raises
    UsageError if the router rejects the request, TransportError if none answers, or later if the router stops.
    """
    parameters = [("case", case) for case in cases] + [("from", source) for source in sources]
    words = urlencode(parameters + ([("only", only)] if only else []))
    with closing(_control(url, PATIENCE)) as connection:
        response = _asked(connection, url, "GET", f"/tap?{words}" if words else "/tap")
        if response.status != http.client.OK:
            raise UsageError(_first_line(_read(response, url)))
        yield _stream(response, url)


def _stream(response: http.client.HTTPResponse, url: str) -> Iterator[list[MirroredDatagram | Action | Lost]]:
    from router.observe.tap import StreamReader

    reader = StreamReader()
    while True:
        try:
            piece = response.read1(PIECE)
        except (OSError, http.client.HTTPException) as error:
            raise TransportError(f"the router at {url} does not answer any more: {error}") from error
        if not piece:
            raise TransportError(f"the router at {url} has stopped")
        yield list(reader.take(piece))


def _connection(url: str, patience: float) -> http.client.HTTPConnection:
    try:
        parts = urlsplit(url if "://" in url else f"http://{url}")
        host, port = parts.hostname, parts.port
        (host or "").encode("idna")
    except ValueError:  # no number for a port, half an IPv6 address, a name with two dots in a row
        host = port = None
    if host is None or port == 0 or parts.scheme != "http" or re.search(r"\s", url):
        raise UsageError(f"'{url}' is not like http://127.0.0.1:9108")
    return http.client.HTTPConnection(host, port or 80, timeout=patience)


class _ControlConnection(http.client.HTTPConnection):
    """A connection to the control socket of the router that serves HTTP at this host and port."""

    def connect(self) -> None:
        from router.net import control
        from router.net.addresses import addresses_of

        errors: list[OSError] = []
        for host in addresses_of(self.host):
            try:
                self.sock = control.connect(host, self.port, self.timeout)
            except OSError as error:
                errors.append(error)
            else:
                return
        raise errors[0]


def _control(url: str, patience: float) -> http.client.HTTPConnection:
    over_tcp = _connection(url, patience)
    return _ControlConnection(over_tcp.host, over_tcp.port, timeout=patience)


def _asked(connection: http.client.HTTPConnection, url: str, method: str, path: str) -> http.client.HTTPResponse:
    host, _, _ = connection.host.partition("%")  # a zone is only for this computer
    headers = {"Host": with_port(host, connection.port)}
    try:
        connection.request(method, path, headers=headers | ({"Content-Length": "0"} if method == "POST" else {}))
        return connection.getresponse()
    except (OSError, http.client.HTTPException) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRNOTAVAIL:
            what = f"{url} is another computer: a router is controlled on its own computer only"
            raise UsageError(what, "log in there") from error
        remedy = "start it, or name another router with -t TABLE or --url"
        why = getattr(error, "strerror", None) or error  # without the number that OSError shows
        raise TransportError(f"{Problem(Kind.ROUTER_DOWN, {'instance': url}).words}: {why}", remedy) from error


def _got(url: str, path: str) -> tuple[bytes, Message]:
    with closing(_connection(url, PATIENCE)) as connection:
        response = _asked(connection, url, "GET", path)
        text = _read(response, url)
        if response.status != http.client.OK:
            raise TransportError(f"{url}{path}: {response.status} {_first_line(text)}")
        return text, response.headers


def _read(response: http.client.HTTPResponse, url: str) -> bytes:
    try:
        return response.read()
    except (OSError, http.client.HTTPException) as error:
        raise TransportError(f"the router at {url} broke the connection: {error}") from error


def _first_line(text: bytes) -> str:
    return next(iter(text.decode(errors="replace").splitlines()), "")
