"""The verb call against servers in other processes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.cli import BAD_USAGE, NETWORK_FAULT, OK, main
from tests.acceptance.service_server import ServiceServer

TABLE = """\
version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 127.0.0.5:7}}
endpoints: {nav_board: {address: 127.0.0.30:8, kind: board}}
node: {namespace: /loki}
services:
  home:
    from: {case: home_request, source: nav_board}
    call: {service: get_home, type: std_srvs/srv/SetBool, timeout: 700ms}
    reply: {case: home_reply}
    on_timeout: {}
  arm:
    type: std_srvs/srv/SetBool
    request: {case: arm_request, to: nav_board, ttl: 1s}
    reply: {case: arm_reply}
    timeout: 1s
    on_timeout: {}
routes: {}
"""
TYPE = "std_srvs/srv/SetBool"


@pytest.fixture
def table(tmp_path: Path) -> str:
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.replace("PROTOS", str(Path(__file__).parents[1] / "bad_tables/protos/calls")))
    return str(path)


@pytest.fixture(scope="module")
def server() -> Iterator[ServiceServer]:
    with ServiceServer("/loki/get_home") as started:
        yield started


@pytest.mark.parametrize("name", ["home", "get_home", "/loki/get_home"])
def test_a_service_of_the_table_is_called_by_each_of_its_names(
    name: str, table: str, server: ServiceServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["call", name, "data=true", "-t", table]) == OK
    assert server.request() == "True"
    told = capsys.readouterr().out
    assert re.fullmatch(r"/loki/get_home responded in [0-9.]+ ms: success=true message=here\n", told)


def test_what_it_responds_does_not_change_the_exit_code(
    server: ServiceServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["call", "/loki/get_home", "--type", TYPE, "--json"]) == OK
    assert server.request() == "False"
    told = json.loads(capsys.readouterr().out)
    assert 0 < told.pop("seconds") < 60
    assert told == {"service": "/loki/get_home", "type": TYPE, "response": {"success": False, "message": "here"}}


def test_a_service_that_nobody_offers(capsys: pytest.CaptureFixture[str], table: str) -> None:
    assert main(["call", "arm", "-t", table, "--timeout", "300ms"]) == NETWORK_FAULT
    assert capsys.readouterr().err.startswith("router call: no server of /loki/arm within 0.3 s\nhelp: ")


def test_a_server_of_another_type(server: ServiceServer, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["/loki/get_home", "--type", "std_srvs/srv/Trigger", "--timeout", "3s"]
    assert main(["call", *words]) == NETWORK_FAULT
    told = f"router call: the server of /loki/get_home has the type {TYPE}, not std_srvs/srv/Trigger\n"
    assert capsys.readouterr().err == told


def test_a_server_that_does_not_respond(capsys: pytest.CaptureFixture[str]) -> None:
    with ServiceServer("slow") as slow:
        slow.wait(60)
        assert main(["call", "slow", "--type", TYPE, "--timeout", "3s"]) == NETWORK_FAULT
        slow.kill()
    assert capsys.readouterr().err == "router call: /slow did not respond within 3 s\n"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["homes"], "TABLE has no service 'homes'\nhelp: did you mean 'home'?; for another service, add its --type\n"),
        (["home", "date=true"], f"{TYPE}_Request has no field 'date'\nhelp: did you mean 'data'?\n"),
        (["home", "data=7"], "data: '7' is not a bool\nhelp: write true or false\n"),
        (["home", "--type", "std_srvs/srv/SetBull"], "there is no ROS service type 'std_srvs/srv/SetBull'\nhelp: did "),
        (["a b", "--type", TYPE], "service 'a b' cannot be called: "),
    ],
)
def test_wrong_words_say_what_to_write(
    words: list[str], told: str, table: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["call", *words, "-t", table]) == BAD_USAGE
    assert capsys.readouterr().err.startswith(f"router call: {told}".replace("TABLE", table))


def test_without_ros_it_says_what_is_missing() -> None:
    words = ["call", "home", "--type", TYPE]
    program = f"import sys; from router.cli import main; sys.modules['rclpy'] = None; sys.exit(main({words}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == BAD_USAGE
    assert done.stderr.startswith("router call: a call needs ROS 2, which is not installed here (")
