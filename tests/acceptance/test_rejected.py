"""What must not pass, and what must though it looks odd: one counter each, and the router goes on."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.acceptance.conftest import Rover
from tests.acceptance.payloads import WIRE, generated, golden
from tests.acceptance.rover_map import FLOWS, HOSTS, OUTFLOWS
from tests.acceptance.site import RouterProcess, Site, balance, key, site

PH = bytes.fromhex("0a110d713dda401560e520401d333345412001")
"""ph_info from the sensor board, which the basestation gets."""

REJECTED = {
    "empty": ("empty", b""),
    "garbage": ("malformed", b"\xff" * 40),
    "text": ("malformed", b"GET / HTTP/1.1\r\n\r\n"),
    "a payload that is cut": ("malformed", PH[:9]),
    "a payload that is no message": ("malformed", bytes.fromhex("0a020d01")),
    "a length beyond the end, not of zeros": ("malformed", bytes.fromhex("0aff7f0d713d")),
    "a length that never ends": ("malformed", b"\x0a" + b"\x80" * 11),
    "something behind the zeros": ("malformed", PH + b"\0\0\x07"),
    "an unknown field": ("unknown_case", bytes.fromhex("fa0100")),
    "the announced timeout": ("unknown_case", bytes.fromhex("f0013c")),
    "the announced timeout of zero": ("unknown_case", bytes.fromhex("f00100")),
    "a known number as a group": ("malformed", b"\x0b\x0c"),
    "a known number as a varint": ("malformed", b"\x08\x07"),
    "an unknown field of a large number": ("unknown_case", bytes.fromhex("82f4030401020304")),
    "more than 16 KiB": ("truncated", PH.ljust(16 * 1024 + 1, b"\0")),
    "a large datagram": ("truncated", b"\x0a\xdc\xd4\x03" + b"\0" * 59_996),
    "the largest datagram": ("truncated", b"\xaa" * 65_507),
}

ACCEPTED = {
    "16 KiB": PH.ljust(16 * 1024, b"\0"),
    "a long tag": b"\x8a\x80\x00" + PH[1:],
    "a long length": b"\x0a\x91\x80\x00" + PH[2:],
    "an unknown field in the payload": bytes.fromhex("0a08 0d713dda40 c83e07".replace(" ", "")),
    "the timeout behind the payload": PH + bytes.fromhex("f0013c"),
    "the timeout before the payload": bytes.fromhex("f0013c") + PH,
    "another case before the payload": bytes.fromhex("1a00") + PH,
    "the payload in two parts": bytes.fromhex("0a050d713dda40 0a022001".replace(" ", "")),
}
"""All of them a ph_info to any protobuf parser, and forwarded as they are."""


def received(datagram: bytes) -> Counter[str]:
    return Counter(
        {key("datagrams_received", listener="rover"): 1, key("received_bytes", listener="rover"): len(datagram)}
    )


def rejected(datagram: bytes, reason: str) -> Counter[str]:
    return received(datagram) + Counter({key("datagrams_rejected", listener="rover", reason=reason): 1})


def unhandled(datagram: bytes, case: str) -> Counter[str]:
    reason = "unknown_case" if case == "unknown" else "unhandled"
    return rejected(datagram, reason) + Counter({key("unhandled", payload_case=case): 1})


def exchange(place: Site, datagram: bytes, *sources: str) -> Counter[str]:
    """Sends it from each source, and gives what was counted. Nothing may arrive anywhere."""
    before = place.scrape()
    for source in sources:
        place.send(source, datagram)
    counted = place.settle(before, len(sources))
    assert place.waiting() == {}
    return counted


def still_routes(place: Site) -> None:
    before = place.scrape()
    place.send("sensor_board", PH)
    assert place.receive("basestation") == PH
    place.settle(before, 1)  # the datagram arrives before all that becomes of it is counted


@pytest.mark.parametrize(("reason", "datagram"), REJECTED.values(), ids=REJECTED)
def test_what_is_no_envelope_with_a_known_payload_is_rejected(rover: Rover, reason: str, datagram: bytes) -> None:
    counted = exchange(rover.site, datagram, "sensor_board")
    assert counted == (unhandled(datagram, "unknown") if reason == "unknown_case" else rejected(datagram, reason))
    still_routes(rover.site)


@pytest.mark.parametrize("datagram", ACCEPTED.values(), ids=ACCEPTED)
def test_whatever_protobuf_can_read_is_forwarded_as_it_is(rover: Rover, datagram: bytes) -> None:
    assert WIRE.decode(datagram).case.name == "ph_info"
    before = rover.site.scrape()
    rover.site.send("sensor_board", datagram)
    assert rover.site.receive("basestation") == datagram
    counted = rover.site.settle(before, 1)
    assert counted[key("sent_bytes", route="ph_info", destination="basestation")] == len(datagram)
    assert rover.site.waiting() == {}


@pytest.mark.parametrize("case", FLOWS)
def test_an_endpoint_may_only_send_what_its_routes_name(rover: Rover, case: str) -> None:
    datagram = next(generated(case)).datagram
    others = [name for name in HOSTS if name != FLOWS[case].source]
    each = rejected(datagram, "source_mismatch")
    assert exchange(rover.site, datagram, *others) == Counter(
        {name: len(others) * count for name, count in each.items()}
    )


def test_a_stranger_may_send_nothing(tmp_path: Path, rover: Rover) -> None:
    with site(tmp_path, {"stranger": "127.0.0.66"}) as elsewhere:
        before = rover.site.scrape()
        elsewhere.listen = rover.site.listen
        elsewhere.send("stranger", PH)
        assert rover.site.settle(before, 1) == rejected(PH, "source_mismatch")
        assert elsewhere.waiting() == rover.site.waiting() == {}


@pytest.mark.parametrize("case", OUTFLOWS)
def test_what_goes_from_ros_to_udp_is_not_taken_from_udp(rover: Rover, case: str) -> None:
    datagram = next(generated(case)).datagram
    assert exchange(rover.site, datagram, "basestation") == unhandled(datagram, case)


@pytest.mark.parametrize(
    ("datagram", "expected"),
    [
        (bytes.fromhex("f001"), unhandled(bytes.fromhex("f001"), "unknown")),
        (b"\0" * 64, rejected(b"\0" * 64, "no_payload")),
    ],
    ids=["a timeout of zero, trimmed", "only zeros"],
)
def test_what_is_repaired_and_then_rejected_is_counted_as_both(
    rover: Rover, datagram: bytes, expected: Counter[str]
) -> None:
    repaired = Counter({key("datagrams_padded", listener="rover"): 1})
    assert exchange(rover.site, datagram, "sensor_board") == expected + repaired


NARROW = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
metrics:
  address: 127.0.0.1:{metrics}
listen:
  rover:
    address: 127.0.0.5:{listen}
    framing: exact
endpoints:
{endpoints}
routes:
  ph_info:
    source: sensor_board
    destinations: [basestation]
  imu_info:
    ignore: a test
"""


def test_a_narrow_table_ignores_and_lacks_cases_and_repairs_nothing(tmp_path: Path) -> None:
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table(NARROW)):
        imu, gps = next(generated("imu_info")).datagram, next(generated("gps_info")).datagram
        empty = golden(bytes.fromhex("0a00")).datagram
        assert exchange(place, imu, "sensor_board") == rejected(imu, "ignored")
        assert exchange(place, gps, "sensor_board") == unhandled(gps, "gps_info")
        for changed in (empty.rstrip(b"\0"), PH.ljust(320, b"\0")):
            assert exchange(place, changed, "sensor_board") == rejected(changed, "malformed")
        still_routes(place)
        balance(place.scrape())
