"""`routes/legacy.yaml` does what the C++ node did: everything to both addresses, four topics, its parameters."""

from __future__ import annotations

from pathlib import Path

from tests.acceptance.expected import in_board_units
from tests.acceptance.payloads import WIRE, generated, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.site import RouterProcess, Site, site, wait_until
from tests.tables import ROUTES

LEGACY = ROUTES / "legacy.yaml"
DESTINATIONS = ("dst_a", "dst_b")
TOPICS = {
    "imu_data": "comms/msg/ImuSensorInformation",
    "gps_data": "comms/msg/SensorBoardGPSInfo",
    "ph_data": "comms/msg/SensorBoardPHInfo",
    "sensor_board_diagnostics": "comms/msg/SensorBoardDiagnostics",
}
CASES = {
    "imu_info": "imu_data",
    "gps_info": "gps_data",
    "ph_info": "ph_data",
    "sensor_diag": "sensor_board_diagnostics",
}

HOSTS = {"anybody": "127.0.0.77", "dst_a": "127.0.0.88", "dst_b": "127.0.0.88"}
"""The old node had one parameter for the address of both destinations."""


def parameters(place: Site) -> dict[str, str]:
    host, port_a = place.endpoints["dst_a"].getsockname()
    port_b = place.endpoints["dst_b"].getsockname()[1]
    return {"listen_port": str(place.listen), "dst_ip": host, "dst_a_port": str(port_a), "dst_b_port": str(port_b)}


def assert_both_get(place: Site, datagram: bytes) -> None:
    place.send("anybody", datagram)
    assert [place.receive(name) for name in DESTINATIONS] == [datagram, datagram]


def test_every_case_goes_to_both_addresses_and_four_to_topics(tmp_path: Path) -> None:
    """Its parameters come from the command line, from a file as ros2 launch writes it, and from the environment."""
    with site(tmp_path, HOSTS) as place:
        (first, *others) = parameters(place).items()
        file, environment = dict(others[:2]), {name.upper(): value for name, value in others[2:]}
        path = tmp_path / "launch_params.yaml"
        lines = "".join(f"    {name}: {value}\n" for name, value in file.items())
        path.write_text(f"/**:\n  ros__parameters:\n{lines}")
        arguments = ("--ros-args", "-p", "{}:={}".format(*first), "--params-file", path)
        with RouterProcess(tmp_path, LEGACY, *arguments, **environment) as router, RosPeer(TOPICS) as peer:
            subscribed(place, peer)
            for case in WIRE.envelopes.first.cases:
                for sent in generated(case):
                    assert_both_get(place, sent.datagram)
                    if case in CASES:
                        assert peer.receive() == (CASES[case], in_board_units(sent.payload))
            assert router.events("message dropped") == router.events("datagram rejected") == []
            assert peer.nothing_left()
            # The one intended difference: garbage is not passed on.
            place.send("anybody", b"\xff" * 20)
            wait_until(lambda: bool(router.events("datagram rejected")), "the rejection")
            assert_both_get(place, next(generated("ph_info")).datagram)
            assert place.waiting() == {}


def subscribed(place: Site, peer: RosPeer) -> None:
    """This table has no metrics to ask: sends until the peer gets messages of all topics."""
    seen: set[str] = set()

    def all_seen() -> bool:
        for case in CASES:
            assert_both_get(place, next(generated(case)).datagram)
        while not peer.nothing_left():
            seen.add(peer.receive()[0])
        return seen == set(TOPICS)

    wait_until(all_seen, "a message on each topic")
    # More may be on their way. On each topic they come before what is sent from here on: an empty payload.
    empty = {case: WIRE.envelopes.first.cases[case].message_class() for case in CASES}
    for case, payload in empty.items():
        assert_both_get(place, sample(case, payload).datagram)
    last = {CASES[case]: in_board_units(payload) for case, payload in empty.items()}
    while last:
        topic, message = peer.receive()
        if last[topic] == message:
            del last[topic]


def test_a_parameter_file_that_is_missing_is_told(tmp_path: Path) -> None:
    router = RouterProcess(tmp_path, LEGACY, "--ros-args", "--params-file", tmp_path / "none.yaml")
    assert router.wait() == 78
    assert router.text().startswith(f"router run: the parameter file {tmp_path / 'none.yaml'} cannot be read: ")
    assert "Traceback" not in router.text()
