"""A rehearsal does what the router does, on a clock that is told to go, and says of everything what became of it."""

from __future__ import annotations

import random
import socket
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from router.app import Router
from router.compiler import check_table
from router.datagrams import Wire, wire_of_protos
from router.rehearsal.rehearsal import START, Filtered, Received, Rehearsal, Rejected, Sent, Superseded
from router.values.reading import payload
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.small_tables import BASESTATION, SENSOR_BOARD, STRANGER, program
from tests.tables import PROTOS

FORWARD = "  imu_info: {source: sensor_board, destinations: [basestation, recorder]}\n"
WIRE = wire_of_protos(PROTOS)


def datagram(case: str, *words: str) -> bytes:
    return WIRE.encode(WIRE.case(case), payload(WIRE.case(case), words))


def test_event_names_route_and_target(tmp_path: Path) -> None:
    made = Rehearsal(program(tmp_path, FORWARD))
    data = datagram("imu_info", "accel_x=1.5")
    made.datagram("trimmed", SENSOR_BOARD, data)
    assert made.events == [
        Received(START, "imu_info", "sensor_board"),
        Sent(START, "imu_info", "basestation", data),
        Sent(START, "imu_info", "recorder", data.rstrip(b"\0")),
    ]


def test_rejected_datagram_tells_its_reason_and_more(tmp_path: Path) -> None:
    made = Rehearsal(program(tmp_path, FORWARD))
    made.datagram("exact", STRANGER, datagram("imu_info"))
    assert made.events == [Rejected(START, "exact", "source_mismatch", "from 192.168.0.99:1234: imu_info")]


def test_unknown_listener_and_topic_are_the_callers_mistake(tmp_path: Path) -> None:
    made = Rehearsal(program(tmp_path, FORWARD))
    with pytest.raises(KeyError):
        made.datagram("nobody", BASESTATION, b"")
    with pytest.raises(KeyError):
        made.ros("nothing", b"")


# beside a router on real sockets


TABLE = """
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: "127.0.0.1:{listen}"}}}}
endpoints:
  sensor_board: {{address: 127.0.0.30:8, kind: board}}
  basestation: {{address: "127.0.0.1:{basestation}", kind: basestation}}
  recorder: {{address: "127.0.0.1:{recorder}", kind: tool, trim_trailing_zeros: true}}
routes:
  imu_info:
    source: sensor_board
    destinations: [{{endpoint: basestation, when: 1 / accel_x > 0.5}}, recorder]
  ph_info: {{source: any, destinations: [basestation]}}
  pump_info: {{ignore: not here}}
"""


def mixed(wire: Wire, count: int) -> list[bytes]:
    """Good ones, trimmed and padded ones, some with two payloads, and such as are none; the same in every run."""
    chance = random.Random(6)
    made = []
    for _ in range(count):
        case = chance.choice(["imu_info", "ph_info", "pump_info", "gps_info"])
        words = [f"accel_x={chance.choice([0, 1, 5])}"] if case == "imu_info" else []
        data = wire.encode(wire.case(case), payload(wire.case(case), words))
        data = chance.choice([data, data, data.rstrip(b"\0"), data.ljust(40, b"\0"), data[:-1] + b"\xff", b"\xff\x01"])
        made.append(
            wire.encode(wire.case("ph_info"), payload(wire.case("ph_info"), [])) + data
            if chance.random() < 0.1
            else data
        )
    return made


def udp(host: str, port: int = 0) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((host, port))
    opened.settimeout(PATIENCE)
    return opened


def test_rehearsal_sends_and_counts_what_the_router_does(tmp_path: Path) -> None:
    with ExitStack() as opened:
        board, basestation, recorder = (
            opened.enter_context(closing(udp(host))) for host in ("127.0.0.30", "127.0.0.1", "127.0.0.1")
        )
        listen = free_port()
        path = tmp_path / "table.yaml"
        ports = {"basestation": basestation.getsockname()[1], "recorder": recorder.getsockname()[1]}
        path.write_text(TABLE.format(protos=PROTOS, listen=listen, **ports))
        made = check_table(path).program
        assert made is not None
        given = mixed(Wire(made.envelopes), 200)
        run = Rehearsal(made)
        for data in given:
            run.datagram("rover", board.getsockname(), data)
        sent = [event for event in run.events if isinstance(event, Sent)]
        with Router(made) as router:
            for data in given:
                board.sendto(data, ("127.0.0.1", listen))
            for receiver, name in ((basestation, "basestation"), (recorder, "recorder")):
                expected = [event.data for event in sent if event.target == name]
                assert [receiver.recv(2048) for _ in expected] == expected
            # Nothing answers the last ones, and the kernel may not have delivered them yet.
            wait_until(lambda: router.total("datagrams_received") == len(given))
        kinds = Counter(type(event) for event in run.events)
        assert router.total("datagrams_sent") == kinds[Sent]
        assert router.total("messages_filtered") == kinds[Filtered]
        assert router.total("datagrams_rejected") == kinds[Rejected]
        assert router.total("superseded_members") == kinds[Superseded] > 0
        assert router.total("messages_dropped") > 0
        assert len(kinds) >= 6
