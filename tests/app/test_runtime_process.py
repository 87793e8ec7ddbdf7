"""`router run` as a process: exit codes, signals, ROS arguments, and what it writes."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.ports import free_port
from tests.tables import PROTOS

ROOT = Path(__file__).parent.parent

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: "127.0.0.1:${{LISTEN_PORT}}"}}
endpoints:
  basestation: {{address: "127.0.0.1:{destination}", kind: basestation}}
routes:
  ph_info: {{source: any, destinations: [basestation]}}
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(protos=PROTOS, destination=free_port()))
    return path


def start(*arguments: str | Path, **environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "router", "run", *map(str, arguments)]
    path = os.pathsep.join(filter(None, (environment.pop("PYTHONPATH", ""), str(ROOT), os.environ.get("PYTHONPATH"))))
    variables = {**os.environ, "PYTHONPATH": path, **environment}
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=variables)


def wait_for_start(process: subprocess.Popen[str]) -> dict[str, object]:
    assert process.stderr
    for line in process.stderr:
        if line.startswith("{") and (entry := json.loads(line))["event"] == "router started":
            return dict(entry)
    raise AssertionError("it did not start")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_gracefully(table: Path, number: signal.Signals) -> None:
    process = start(table, LISTEN_PORT=str(free_port()))
    wait_for_start(process)
    process.send_signal(number)
    _, log = process.communicate(timeout=10)
    assert process.returncode == 0
    events = [json.loads(line)["event"] for line in log.splitlines()]
    assert events == ["router stopping", "router stopped"]


def test_a_ros_parameter_is_a_table_variable_and_wins_over_the_environment(table: Path) -> None:
    port = free_port()
    process = start(table, "--ros-args", "-p", f"listen_port:={port}", LISTEN_PORT=str(free_port()))
    assert wait_for_start(process)["listening"] == {"rover": f"127.0.0.1:{port}"}
    process.terminate()
    process.communicate(timeout=10)


def test_a_machine_without_ros_is_told_what_to_do(table: Path, tmp_path: Path) -> None:
    without = tmp_path / "without_ros"
    without.mkdir()
    (without / "rclpy.py").write_text("raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')\n")
    topics = "topics: [{topic: ph, type: comms/msg/SensorBoardPHInfo, fields: auto}]"
    table.write_text(table.read_text().replace("destinations: [basestation]", topics))
    process = start(table, LISTEN_PORT=str(free_port()), PYTHONPATH=str(without))
    _, text = process.communicate(timeout=10)
    assert process.returncode == 78
    assert text.splitlines()[-1] == (
        f"router run: {table} has topics, and ROS 2 cannot be loaded: No module named 'rclpy'; "
        "run 'make setup', or source the setup.sh of an installed ROS 2 Jazzy"
    )


def test_a_table_with_errors_is_told_and_ends_with_78(table: Path) -> None:
    table.write_text(table.read_text().replace("destinations: [basestation]", "destinations: [nobody]"))
    process = start(table, LISTEN_PORT=str(free_port()))
    _, text = process.communicate(timeout=10)
    assert process.returncode == 78
    assert f"{table}:8:41: error[unknown-endpoint]" in text


def test_a_port_in_use_is_told_and_ends_with_78(table: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        process = start(table, LISTEN_PORT=str(taken.getsockname()[1]))
        _, text = process.communicate(timeout=10)
    assert process.returncode == 78
    assert f"router run: {table}:4:20: listener 'rover' cannot use" in text
    assert f"(pid {os.getpid()}) has the port" in text


def test_sighup_and_the_command_have_the_table_read_again(table: Path) -> None:
    metrics, listen = free_port(kind=socket.SOCK_STREAM), free_port()
    table.write_text(f'metrics: {{address: "127.0.0.1:{metrics}"}}\n' + table.read_text())
    process = start(table, LISTEN_PORT=str(listen))
    wait_for_start(process)
    good = table.read_text()
    asking = [sys.executable, "-m", "router", "reload", str(table)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "LISTEN_PORT": str(listen)}

    table.write_text(good + "  gps_info: {source: any, destinations: [basestation]}\n")
    answer = subprocess.run(asking, env=environment, capture_output=True, text=True, check=False)
    assert (answer.returncode, answer.stdout) == (0, "route gps_info added\n")

    table.write_text(good + "  gps_infos: {source: any, destinations: [basestation]}\n")
    answer = subprocess.run(asking, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 78
    assert "unknown-payload-case" in answer.stderr
    assert "nothing has changed: the table has 1 error" in answer.stderr

    table.write_text(good)
    process.send_signal(signal.SIGHUP)
    assert process.stderr
    told = next(entry for entry in map(json.loads, process.stderr) if entry.get("result") == "route gps_info removed")
    assert told["event"] == "table reloaded"
    process.terminate()
    process.communicate(timeout=10)
    assert process.returncode == 0


def test_it_stops_however_many_reloads_are_asked_for(table: Path) -> None:
    process = start(table, LISTEN_PORT=str(free_port()))
    wait_for_start(process)
    ended = threading.Event()

    def storm() -> None:
        while not ended.wait(0.001):
            process.send_signal(signal.SIGHUP)

    thread = threading.Thread(target=storm)
    thread.start()
    try:
        assert process.stderr
        assert any('"table reloaded"' in line for line in process.stderr)
        process.terminate()
        process.communicate(timeout=10)
    finally:
        ended.set()
        thread.join()
        process.kill()
    assert process.returncode == 0
