"""The live view of a router in a process of its own, beside its routing."""

from __future__ import annotations

import signal
import socket
import time
from contextlib import suppress
from itertools import cycle, islice
from pathlib import Path
from time import monotonic

from tests.acceptance.payloads import generated
from tests.acceptance.site import ROVER, RouterProcess, Site, balance, site, total
from tests.observe.foxglove_client import PATIENCE, FoxgloveClient
from tests.ports import free_port

MANY = 200


def wait_until_watching(place: Site, client: FoxgloveClient) -> int:
    """Nobody says when the subscription has come; so datagrams are sent until one is shown. Returns how many."""
    deadline, sent = monotonic() + PATIENCE, 0
    while monotonic() < deadline:
        sent += 1
        place.send("sensor_board", next(generated("imu_info")).datagram)
        with suppress(TimeoutError):
            client.receive(0.1)
            return sent
    raise AssertionError("nothing is shown")


def test_a_client_sees_what_arrives_and_routing_goes_on_without_it(tmp_path: Path) -> None:
    with site(tmp_path) as place:
        port = free_port(kind=socket.SOCK_STREAM)
        table = place.table(ROVER + f"\nfoxglove:\n  address: 127.0.0.1:{port}\n")
        with RouterProcess(tmp_path, table) as router:
            samples = list(islice(cycle(generated("imu_info")), MANY))
            with FoxgloveClient(port) as client:
                client.subscribe("imu_info")
                at_start = place.scrape()
                place.settle(at_start, wait_until_watching(place, client))
                before, since = place.scrape(), time.time_ns()
                for sample in samples:
                    place.send("sensor_board", sample.datagram, b"\xff")
                wanted = [sample.payload.SerializeToString() for sample in samples]
                told = [client.receive()]
                while [each.data for each in told[-MANY:]] != wanted:
                    told.append(client.receive())
                times = [each.log_time for each in told[-MANY:]]
                assert times == sorted(times)
                assert since < times[0] < times[-1] < time.time_ns()
            place.send("sensor_board", *(sample.datagram for sample in samples))
            counted = place.settle(before, 3 * MANY)
            assert total(counted, "datagrams_rejected", reason="malformed") == MANY
            assert total(counted, "mirror_dropped") == 0
            balance(place.scrape())
            with FoxgloveClient(port) as client:
                client.subscribe("imu_info")
                wait_until_watching(place, client)
                assert router.stop(signal.SIGTERM) == 0  # while somebody looks on
            assert {line["level"] for line in router.log()} <= {"info", "warning"}, router.text()
