"""What the doctor says of services, with servers in other processes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.compiler import check_table
from router.tools.doctor import examine
from router.tools.doctor_checks import CheckResult, Grade, ros
from router.tools.service_checks import services
from tests.acceptance.service_server import ServiceServer
from tests.acceptance.site import wait_until

TABLE = """\
version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 127.0.0.5:7}}
endpoints: {nav_board: {address: 127.0.0.30:8, kind: board}}
node: {namespace: /doctor}
services:
  home:
    from: {case: home_request, source: nav_board}
    call: {service: get_home, type: TYPE, timeout: 700ms, fields: {data: fast}}
    reply: {case: home_reply, fields: {found: success}}
    on_timeout: {found: false}
  arm:
    type: std_srvs/srv/SetBool
    request: {case: arm_request, to: nav_board, fields: {armed: data}, ttl: 1s}
    reply: {case: arm_reply, fields: {success: ok}}
    timeout: 1s
    on_timeout: {success: false}
routes: {}
"""
SETBOOL, TRIGGER = "std_srvs/srv/SetBool", "std_srvs/srv/Trigger"


def found(folder: Path, type_name: str = SETBOOL) -> list[CheckResult]:
    path = folder / "table.yaml"
    text = TABLE.replace("PROTOS", str(Path(__file__).parents[1] / "bad_tables/protos/calls")).replace(
        "TYPE", type_name
    )
    path.write_text(text if type_name == SETBOOL else text.replace(", fields: {data: fast}", ""))
    checked = check_table(path, {})
    assert checked.program is not None, checked.diagnostics
    assert [result.grade for result in ros(checked.program)] == [Grade.FINE]
    assert "service type" in next(ros(checked.program)).text
    return [*services(checked.program)]


def test_a_called_service_without_a_server(tmp_path: Path) -> None:
    (result,) = found(tmp_path)
    assert result.grade is Grade.WARNING
    assert result.text == "no server of /doctor/get_home, which 'home' calls: every call gets `on_timeout`"
    assert result in [*examine(tmp_path / "table.yaml", os.environ)]


def test_services_that_clients_call(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    items = [f"{{service: {name}, type: {SETBOOL}, timeout: 1s}}" for name in ("get_home", "lost")]
    gateway = f"gateways: {{it: {{transport: {{websocket: 127.0.0.1:8601}}, inbound: [{', '.join(items)}]}}}}"
    path.write_text(f"version: 1\nnode: {{namespace: /doctor}}\n{gateway}\n")
    program = check_table(path, {}).program
    assert program is not None
    assert "and 1 service type of" in next(ros(program)).text
    lost = "no server of /doctor/lost, which 'it:/doctor/lost' calls: every call fails"
    with ServiceServer("/doctor/get_home"):
        wait_until(lambda: [result.text for result in services(program)] == [lost])


def test_servers_are_compared_with_the_table(tmp_path: Path) -> None:
    def says(text: str, type_name: str = SETBOOL) -> bool:
        results = found(tmp_path, type_name)
        assert all((result.grade is Grade.WARNING) == bool(result.remedy) for result in results)
        return [result.text for result in results] == [text]

    with ServiceServer("/doctor/get_home"):
        wait_until(lambda: says("1 service that no other node offers and 1 called service with a server"))
        mistyped = f"/service_server offers /doctor/get_home as {SETBOOL}; 'home' calls {TRIGGER}"
        wait_until(lambda: says(mistyped, TRIGGER))
        with ServiceServer("/doctor/arm"):
            wait_until(lambda: says("/service_server also offers the service /doctor/arm"))
