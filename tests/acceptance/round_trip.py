"""Two routers back to back: one publishes what it receives by UDP, and the other sends it to UDP again.

Their tables are derived from the envelope's payload cases, each with a route in both directions.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from router.types.protobuf import PayloadCase
from tests.acceptance.expected import from_board_units, in_board_units
from tests.acceptance.payloads import WIRE, Sample, generated, sample
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.site import RouterProcess, Site, site, wait_until
from tests.tables import PROTOS
from tests.wire.test_comms import OTHER_FIELDS, OTHER_NAMES

AT_ONCE = 50
"""Datagrams in flight at most, so that none is lost."""

DEPTH = 1000
NEAR = "near"
"""The name of each router's only endpoint."""


def table(place: Site, publishes: str, listens: str) -> dict[str, Any]:
    """The table of a router that publishes to one namespace and sends what it receives from the other."""
    host, port = place.endpoints[NEAR].getsockname()
    return {
        "version": 1,
        "envelope": {"protos": str(PROTOS), "message": "PBEnvelope", "oneof": "payload"},
        "http": {"address": f"127.0.0.1:{place.metrics}"},
        "listen": {"all": {"address": f"{ROUTER}:{place.listen}", "receive_buffer": "4MiB"}},
        "endpoints": {NEAR: {"address": f"{host}:{port}", "kind": "tool"}},
        "routes": {case.name: _routes(case, publishes, listens) for case in WIRE.envelopes.first.cases.values()},
    }


def _routes(case: PayloadCase, publishes: str, listens: str) -> list[dict[str, Any]]:
    name = case.type.name
    renamed = {field: ros for (message, field), ros in OTHER_FIELDS.items() if message == name}
    kind = {"type": f"comms/msg/{OTHER_NAMES.get(name, name)}", "queue_depth": DEPTH}
    into_ros = {"auto": True, **{ros: field for field, ros in renamed.items()}}
    return [
        {"source": NEAR, "topics": [{"topic": f"{publishes}/{case.name}", **kind, "fields": into_ros}]},
        {
            "source": {"topic": f"{listens}/{case.name}", **kind},
            "fields": {"auto": True, **renamed},
            "destinations": [NEAR],
        },
    ]


@contextmanager
def back_to_back(folder: Path) -> Iterator[tuple[Site, Site]]:
    """Two sites: datagrams sent to the router of one arrive at the endpoint of the other."""
    with ExitStack() as stack:
        sites = []
        for name, host, topics in (("left", "127.0.0.11", "ab"), ("right", "127.0.0.12", "ba")):
            (folder / name).mkdir()
            sites.append(stack.enter_context(site(folder / name, {NEAR: host})))
            path = folder / name / "table.yaml"
            path.write_text(json.dumps(table(sites[-1], *topics), indent=1))
            stack.enter_context(RouterProcess(folder / name, path))
        left, right = sites
        _connected(left, right)
        _connected(right, left)
        yield left, right


def turned(sent: Sample) -> bytes:
    """The expected payload at the far end: the fields that the ROS message also has."""
    return from_board_units(sent.case, in_board_units(sent.payload)).datagram


def carried(start: Site, end: Site, samples: Iterable[Sample]) -> Iterator[tuple[Sample, bytes]]:
    """Each sample with the datagram that arrived for it."""
    waiting = iter(samples)
    while turn := list(islice(waiting, AT_ONCE)):
        start.send(NEAR, *(sent.datagram for sent in turn))
        for sent in turn:
            yield sent, end.receive(NEAR)


def _connected(start: Site, end: Site) -> None:
    """Wait until publishers and subscriptions have matched and no message is in flight."""
    empty = {
        case: sample(case, WIRE.envelopes.first.cases[case].message_class()) for case in WIRE.envelopes.first.cases
    }
    seen: set[str] = set()

    def all_seen() -> bool:
        for case, nothing in empty.items():
            start.send(NEAR, next(some.datagram for some in generated(case) if turned(some) != turned(nothing)))
        seen.update(WIRE.decode(datagram).case.name for datagram in end.waiting().get(NEAR, ()))
        return seen == set(empty)

    wait_until(all_seen, "the last match")
    # On each topic, the messages sent above arrive before those sent from here on.
    start.send(NEAR, *(nothing.datagram for nothing in empty.values()))
    last = {turned(nothing) for nothing in empty.values()}
    while last:
        last.discard(end.receive(NEAR))
