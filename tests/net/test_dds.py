"""UDP ports that ROS uses: which they are, which ones ROS binds, and what start and doctor say about a table's."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from router.app import Router
from router.cli import main
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.errors import ConfigurationError
from router.net.dds import clashes
from router.net.kernel import BELOW_ROS, why_not_bound
from tests.small_tables import HEAD
from tests.tables import PROTOS

TO_ROS = "  ph_info: {source: sensor_board, topic: {topic: ph, type: comms/msg/SensorBoardPHInfo, fields: auto}}\n"
FORWARDED = "  ph_info: {source: sensor_board, destinations: basestation}\n"

LISTING = """
import os
from router.ros.node import open_node
node = open_node("listed")
print(open("/proc/net/udp").read(), flush=True)
os._exit(0)
"""


def table(folder: Path, port: int, route: str = TO_ROS) -> Path:
    text = HEAD.replace("PROTOS", str(PROTOS)) + route
    path = folder / "table.yaml"
    path.write_text(text.replace("127.0.0.1:5000", f"127.0.0.1:{port}"))
    return path


def compiled(path: Path) -> CompiledTable:
    program = check_table(path).program
    assert program is not None
    return program


@pytest.mark.parametrize(
    ("port", "domain", "blinds"),
    [
        (7400, "0", True),
        (7400, "", True),
        (7650, "1", True),
        (65400, "232", True),
        (7401, "0", False),
        (7410, "0", False),
        (7649, "0", False),
        (7000, "0", False),
        (7099, "7", False),
    ],
)
def test_ports_that_ros_uses(port: int, domain: str, blinds: bool, tmp_path: Path) -> None:
    [clash] = clashes(compiled(table(tmp_path, port)), {"ROS_DOMAIN_ID": domain})
    assert (clash.address.port, clash.blinds) == (port, blinds)
    assert str(clash).startswith(f"listener 'trimmed' has 127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("port", "variables"),
    [
        (5000, {}),
        (6999, {}),
        (7100, {}),
        (7399, {}),
        (7400, {"ROS_DOMAIN_ID": "1"}),
        (7650, {}),
        (7400, {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}),
        (7400, {"ROS_DOMAIN_ID": "none"}),
    ],
)
def test_ports_that_ros_does_not_use(port: int, variables: dict[str, str], tmp_path: Path) -> None:
    assert list(clashes(compiled(table(tmp_path, port)), variables)) == []


def test_a_gateway_that_receives_at_one_is_named(tmp_path: Path) -> None:
    gateway = "gateways: {g: {transport: {udp: 127.0.0.9:8502}, receive: 127.0.0.1:7400, topics: {include: [/a]}}}\n"
    [clash] = clashes(compiled(table(tmp_path, 5000, TO_ROS + gateway)), {})
    assert str(clash).startswith("gateway 'g' has 127.0.0.1:7400, the port through which ROS processes of domain 0")


def test_ros_uses_ipv4_ports_only(tmp_path: Path) -> None:
    gateway = "gateways: {g: {transport: {udp: '[::1]:8502'}, receive: '[::1]:7400', topics: {include: [/a]}}}\n"
    assert list(clashes(compiled(table(tmp_path, 5000, TO_ROS + gateway)), {})) == []


def test_ros_binds_the_ports_that_are_taken_for_its_own(tmp_path: Path) -> None:
    """One more than the standard of DDS says, from 7000 on."""
    pytest.importorskip("rclpy", reason="needs ROS 2")
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("only root can have a network of its own, by unshare")
    up = "ip link set lo up && ip route add 224.0.0.0/4 dev lo && exec"
    command = ["unshare", "-n", "sh", "-c", f'{up} "$@"', "sh", sys.executable, "-c", LISTING]
    environment = {
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "ROS_DOMAIN_ID": "3",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }
    rows = subprocess.check_output(command, env=environment, text=True).splitlines()[1:]
    bound = {int(row.split()[1].rpartition(":")[2], 16) for row in rows if row}
    lasting = sorted(port for port in bound if port < 32768)
    assert lasting[:2] == [7000, 8150]
    for port in lasting:
        [clash] = clashes(compiled(table(tmp_path, port)), {"ROS_DOMAIN_ID": "3"})
        assert clash.blinds == (port == 8150)


def discovery_port() -> int:
    return 7400 + 250 * int(os.environ["ROS_DOMAIN_ID"])


def test_a_start_that_would_blind_ros_in_the_router_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    port = discovery_port()
    path = table(tmp_path, port)
    said = rf"table.yaml:4:22: listener 'trimmed' has 127.0.0.1:{port}, the port through which ROS processes of domain"
    with pytest.raises(ConfigurationError, match=said), Router(compiled(path)):
        pass
    with pytest.raises(ConfigurationError, match=BELOW_ROS), Router(compiled(path)):
        pass
    assert main(["doctor", "--pre-start", "-t", str(path)]) == 1
    assert f"problem  ports      listener 'trimmed' has 127.0.0.1:{port}" in capsys.readouterr().out


def test_a_start_that_would_blind_others_warns(tmp_path: Path) -> None:
    port = discovery_port()
    with capture_logs() as logs, Router(compiled(table(tmp_path, port, FORWARDED))):
        pass
    [said] = [each for each in logs if "find each other" in each["event"]]
    assert (said["log_level"], said["remedy"]) == ("warning", BELOW_ROS)


def test_the_doctor_names_a_port_that_ros_may_take_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["doctor", "-t", str(table(tmp_path, 7003))])
    said = capsys.readouterr().out
    assert (
        "warning  ports      listener 'trimmed' has 127.0.0.1:7003, a port that a ROS process of this computer may"
        in said
    )
    assert f"-> {BELOW_ROS}" in said


def test_a_port_that_the_routers_own_node_has_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        monkeypatch.setenv("ROS_DOMAIN_ID", str((port - 7400) // 250))
        kind, why, remedy = why_not_bound("udp", port, OSError(98, "Address already in use"))
    assert (kind, remedy) == (ConfigurationError, BELOW_ROS)
    assert why == f"the ROS node of the router itself (pid {os.getpid()}) has the port"
