"""A rehearsal beside a router on real sockets, with the same datagrams."""

from __future__ import annotations

import random
import socket
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path

from router.app import Router
from router.compiler import check_table
from router.engine.wire import Wire
from router.rehearsal.rehearsal import Filtered, Rehearsal, Rejected, Sent
from router.values import payload
from tests.ports import free_port
from tests.tables import PROTOS

BOARD = ("127.0.0.30", 0)
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


def datagrams(wire: Wire, count: int) -> list[bytes]:
    """Good ones, trimmed and padded ones, and such as are none; the same in every run."""
    chance = random.Random(6)
    made = []
    for _ in range(count):
        case = chance.choice(["imu_info", "ph_info", "pump_info", "gps_info"])
        words = [f"accel_x={chance.choice([0, 1, 5])}"] if case == "imu_info" else []
        data = wire.encode(wire.case(case), payload(wire.case(case), words))
        data = chance.choice([data, data, data.rstrip(b"\0"), data.ljust(40, b"\0"), data[:-1] + b"\xff", b"\xff\x01"])
        made.append(data)
    return made


def udp(host: str, port: int = 0) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((host, port))
    opened.settimeout(5)
    return opened


def test_rehearsal_sends_and_counts_what_the_router_does(tmp_path: Path) -> None:
    with ExitStack() as opened:
        board, basestation, recorder = (
            opened.enter_context(closing(udp(host))) for host in (BOARD[0], "127.0.0.1", "127.0.0.1")
        )
        listen = free_port()
        path = tmp_path / "table.yaml"
        ports = {"basestation": basestation.getsockname()[1], "recorder": recorder.getsockname()[1]}
        path.write_text(TABLE.format(protos=PROTOS, listen=listen, **ports))
        program = check_table(path).program
        assert program is not None
        given = datagrams(Wire(program.envelope), 200)
        rehearsal = Rehearsal(program)
        for data in given:
            rehearsal.datagram("rover", board.getsockname(), data)
        sent = [event for event in rehearsal.events if isinstance(event, Sent)]
        with Router(program) as router:
            for data in given:
                board.sendto(data, ("127.0.0.1", listen))
            for receiver, name in ((basestation, "basestation"), (recorder, "recorder")):
                expected = [event.data for event in sent if event.target == name]
                assert [receiver.recv(2048) for _ in expected] == expected
        kinds = Counter(type(event) for event in rehearsal.events)
        assert router.total("datagrams_sent") == kinds[Sent]
        assert router.total("messages_filtered") == kinds[Filtered]
        assert router.total("datagrams_rejected") == kinds[Rejected]
        assert router.total("messages_dropped") > 0
        assert len(kinds) >= 5
