from __future__ import annotations

import json
import socket

from router.engine.wire import Wire
from router.table.addresses import Address
from router.tools.places import open_udp
from router.tools.tap import listen, received
from router.values import payload


def datagram(wire: Wire, *words: str) -> bytes:
    case = wire.case("every_kind")
    return wire.encode(case, payload(case, words))


def test_a_line_tells_time_peer_case_and_fields(wire: Wire) -> None:
    told = received(datagram(wire, "i32=5", "mode=MODE_ON"), "board", wire)
    assert told.line(with_hex=False).split(" ", 1)[1] == "board every_kind i32=5 mode=MODE_ON"
    assert told.line(with_hex=True).endswith("[0a0410056001]")


def test_repairs_are_told(wire: Wire) -> None:
    assert received(b"\x12", "board", wire).line(with_hex=False).endswith("(trimmed: 1 zeros put back)")
    assert received(b"\x12\0\0\0", "board", wire).line(with_hex=False).endswith("(padded: 2 zeros taken off)")


def test_an_undecodable_datagram_is_shown_with_reason_and_bytes(wire: Wire) -> None:
    told = received(b"\xff\xff", "127.0.0.1:5", wire)
    assert told.line(with_hex=False).split(" ", 1)[1] == "127.0.0.1:5 undecodable (malformed: no PBEnvelope): ffff"
    assert json.loads(told.json(with_hex=False))["hex"] == "ffff"


def test_json_has_the_fields_by_their_proto_names(wire: Wire) -> None:
    said = json.loads(received(datagram(wire, "point.x=3", "single=nan"), "board", wire).json(with_hex=False))
    assert said["fields"] == {"single": "NaN", "point": {"x": 3}}
    assert (said["case"], said["peer"], said["bytes"], "hex" in said) == ("every_kind", "board", 11, False)


def test_datagrams_are_heard_in_order(wire: Wire) -> None:
    with open_udp(Address("127.0.0.1", 0), "tap") as tap, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        for data in (b"\x12\x00", b"", b"\x0a\x00"):
            board.sendto(data, tap.getsockname())
        hearing = listen(tap, wire, lambda peer: f"port {peer[1]}")
        first, second, third = next(hearing), next(hearing), next(hearing)
    assert first.decoded is not None
    assert third.decoded is not None
    assert (first.decoded.case.name, second.problem, third.decoded.case.name) == ("plain", "empty", "every_kind")
    assert first.peer.startswith("port ")
