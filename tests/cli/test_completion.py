"""What bash completes, with the script that `router --completion bash` prints."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tables import PROTOS, ROUTES

_SCRIPT = """
router() { "$PYTHON" -m router "$@"; }
eval "$(router --completion bash)"
COMP_LINE="$1"; COMP_POINT=${#1}; COMP_TYPE=9
_python_argcomplete router
printf '%s\\n' "${COMPREPLY[@]}"
"""
BROKEN = """\
version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {rover: {address: nonsense}}
endpoints:
  board: {address: 127.0.0.30:8, kind: board}
routes:
  imu_info: {source: board, topic: imu, max_rate: often}
  gps_info: {source: board, topic: gps}
"""


def completed(line: str, folder: Path, **variables: str) -> list[str]:
    """What bash offers for the last word of a line that is typed in a folder, sorted."""
    environment = {name: value for name, value in os.environ.items() if name != "ROUTER_TABLE"}
    environment |= {"PYTHON": sys.executable, "PYTHONPATH": str(Path(__file__).parents[2]), **variables}
    command = ["/bin/bash", "--norc", "-c", _SCRIPT, "bash", line]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True, timeout=60)
    return sorted(done.stdout.split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the rover's tables in it, and nothing else."""
    made = tmp_path_factory.mktemp("rover")
    (made / "routes").symlink_to(ROUTES)
    return made


BOARDS = ["arm_board", "container_board", "driving_board", "sensor_board"]


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("router expl", ["explain"]),
        ("router explain im", ["imu_info"]),
        ("router explain das", ["dashboard"]),
        ("router explain imu_info --given gyro_", ["gyro_x=", "gyro_y=", "gyro_z="]),
        ("router tap flow_sensor_info ph", ["ph_info"]),
        ("router tap --from ", [*BOARDS[:1], "basestation", *BOARDS[1:]]),
        ("router send manual_", ["manual_arm", "manual_brake", "manual_drive"]),
        ("router send detected_object bb", ["bbox."]),
        ("router send detected_object bbox.w", ["bbox.width="]),
        ("router send imu_info state=SENSOR_O", ["SENSOR_OPERATING"]),
        ("router send imu_info is_calibrated=", ["false", "true"]),
        ("router send imu_info --to ro", ["rover"]),
        ("router send imu_info --to rover --from sen", ["sensor_board"]),
        ("router sim --silent bas", ["basestation:"]),
        ("router sim --obey driving_board:manual_drive,rock_measure_req", ["manual_drive,rock_measure_request"]),
        ("router listen ", ["envelope://", "tcp://", "topic://", "udp://", "ws://", "zenoh://"]),
        ("router listen topic://imu/", ["//imu/data_raw", "//imu/mag"]),
        ("router listen envelope://ro", ["//rover"]),
        ("router listen udp://8500 --topic /imu/", ["/imu/data_raw", "/imu/mag"]),
        ("router call --type std_srvs/srv/SetBool x ", ["data="]),
        ("router replay it.mcap --to arm", ["arm_board"]),
        ("router new SensorBoardDose --number 99 --board sen", ["sensor_board"]),
    ],
)
def test_words_of_the_table(line: str, offered: list[str], folder: Path) -> None:
    assert completed(line, folder) == offered


def test_the_table_is_the_one_that_is_named_before(folder: Path) -> None:
    assert completed("router explain rock_", folder) == ["rock_measure_request", "rock_measure_result"]
    own = folder / "own.yaml"
    own.write_text(BROKEN.replace("PROTOS", str(PROTOS)).replace("imu_info", "rock_measure_result"))
    assert completed("router explain -t own.yaml rock_", folder) == ["rock_measure_result"]
    assert completed("router explain rock_", folder, ROUTER_TABLE="own.yaml") == ["rock_measure_result"]


def test_a_table_with_errors_completes_what_is_written_in_it(tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text(BROKEN.replace("PROTOS", shlex.quote(str(PROTOS))))
    assert completed("router explain -t broken.yaml ", tmp_path) == ["gps_info", "imu_info"]
    assert completed("router tap -t broken.yaml --from ", tmp_path) == ["board"]
    assert completed("router send -t broken.yaml imu", tmp_path) == ["imu_info"]


def test_services_of_the_table_and_their_fields(tmp_path: Path) -> None:
    services = """services:
  home:
    from: {case: imu_info, source: board}
    call: {service: get_home, type: std_srvs/srv/SetBool, timeout: 1s}
    reply: {case: imu_info}
    on_timeout: {}
"""
    (tmp_path / "table.yaml").write_text(BROKEN.replace("PROTOS", shlex.quote(str(PROTOS))) + services)
    assert completed("router call -t table.yaml h", tmp_path) == ["home"]
    assert completed("router explain -t table.yaml h", tmp_path) == ["home"]
    assert completed("router call -t table.yaml home data=", tmp_path) == ["false", "true"]


@pytest.mark.parametrize("text", ["", "][", "envelope: {protos: nowhere, message: A, oneof: b}"])
def test_a_table_that_cannot_be_read_completes_nothing(text: str, tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    assert completed("router tap -t bad.yaml im", tmp_path) == []
    assert completed("router explain -t absent.yaml im", tmp_path) == []
