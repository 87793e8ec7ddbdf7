"""`router status`: a line and an exit code."""

from __future__ import annotations

import json
import socket

import pytest

from router.cli import NETWORK_FAULT, OK, main
from router.cli.status import DEGRADED, _problems
from router.observe.snapshot import parse_metrics
from tests.ports import free_port
from tests.tools.answering import COLLECTED_AT, answering

WELL = f"""\
router_datagrams_received_total{{listener="rover"}} 7
router_messages_received_total{{route="imu_info",source="sensor_board"}} 7
router_messages_received_total{{route="ph_info",source="arm_board"}} 0
router_endpoint_last_seen_timestamp_seconds{{endpoint="sensor_board"}} {COLLECTED_AT - 1}
router_endpoint_last_seen_timestamp_seconds{{endpoint="arm_board"}} 0
router_endpoint_last_seen_timestamp_seconds{{endpoint="laptop"}} 1
router_endpoint_stale_after_seconds{{endpoint="sensor_board"}} 5
router_endpoint_stale_after_seconds{{endpoint="arm_board"}} 5
router_endpoint_stale_after_seconds{{endpoint="laptop"}} 5
router_deadman_active{{route="drive"}} 0
router_publish_stalled_seconds{{topic="imu_data"}} 0.9
router_config_last_reload_successful 1
router_listener_waiting{{listener="tunnel"}} 0
"""
ILL = (
    WELL.replace(str(COLLECTED_AT - 1), str(COLLECTED_AT - 8))
    .replace('route="drive"} 0', 'route="drive"} 1')
    .replace("successful 1", "successful 0")
    .replace('"tunnel"} 0', '"tunnel"} 1')
    .replace('"imu_data"} 0.9', '"imu_data"} 7')
)

TROUBLES = (
    "its last reload failed; listener tunnel waits for its address or network interface; "
    "sensor_board is silent for 8 s; the deadman of drive sends; "
    "publishing on imu_data is stuck in the ROS middleware, for 7 s"
)


@pytest.mark.parametrize(
    ("metrics", "healthz", "code", "line"),
    [
        (WELL, 200, OK, "running: 7 datagrams received\n"),
        (WELL.replace('"rover"} 7', '"rover"} 1'), 200, OK, "running: 1 datagram received\n"),
        (WELL, 503, DEGRADED, "degraded: the receive thread is stuck; 7 datagrams received\n"),
        (
            ILL,
            200,
            DEGRADED,
            f"degraded: {TROUBLES}; 7 datagrams received\n",
        ),
    ],
)
def test_it_says_in_a_line_what_is_wrong(
    metrics: str, healthz: int, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with answering(metrics, healthz=healthz) as url:
        assert main(["status", "--url", url]) == code
    assert capsys.readouterr().out == line


def test_where_none_runs_that_is_the_answer(capsys: pytest.CaptureFixture[str]) -> None:
    url = f"http://127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
    assert main(["status", "--url", url]) == NETWORK_FAULT
    assert capsys.readouterr().out.startswith(f"down: no router answers at {url}: ")
    assert main(["status", "--url", url, "--json"]) == NETWORK_FAULT
    told = json.loads(capsys.readouterr().out)
    assert (told["state"], told["url"], told["received"]) == ("down", url, None)


def test_who_never_sent_is_switched_off() -> None:
    assert list(_problems(parse_metrics(WELL, COLLECTED_AT))) == []
