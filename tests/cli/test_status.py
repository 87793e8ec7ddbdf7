"""`router status`: a line and an exit code."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

import pytest

from router.cli import NETWORK_FAULT, OK, main
from router.cli.status import DEGRADED
from router.observe.problems import Kind, Problem
from router.observe.services import ServiceReading
from router.observe.states import StateReading
from tests.tools.answering import answering

SILENT = Problem(Kind.ENDPOINT_SILENT, {"endpoint": "arm_board"}, ": last heard 8 s ago", "Check power and cable.")
HELD = Problem(Kind.DEADMAN_ACTIVE, {"route": "drive"}, routes=("drive",))
HALTED = Problem(Kind.HALTED, {"route": "drive"}, " for 27 min", routes=("drive",))
SWITCHED_OFF = Problem(Kind.ENDPOINT_NEVER_HEARD, {"endpoint": "arm_board"})


@pytest.mark.parametrize(
    ("problems", "code", "line"),
    [
        ([], OK, "running: 7 datagrams received"),
        ([SWITCHED_OFF], OK, "running: arm_board has not been heard since the router started; 7 datagrams received"),
        ([HALTED], OK, "running: drive is halted: no commands for 27 min; 7 datagrams received"),
        (
            [SILENT, HALTED],
            DEGRADED,
            (
                "degraded: arm_board is silent: last heard 8 s ago; drive is halted: no commands for 27 min; "
                "7 datagrams received"
            ),
        ),
        (
            [SILENT, HELD],
            DEGRADED,
            f"degraded: arm_board is silent: last heard 8 s ago; {HELD.words}; 7 datagrams received",
        ),
    ],
)
def test_it_says_in_a_line_what_is_wrong(
    problems: Sequence[Problem], code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with answering("", problems=problems) as url:
        assert main(["status", "--url", url]) == code
    assert capsys.readouterr().out == f"{line}\n"


def test_scripts_get_the_kind_of_each_problem_and_where_to_read_on(capsys: pytest.CaptureFixture[str]) -> None:
    with answering("", problems=[SILENT]) as url:
        assert main(["status", "--url", url, "--json"]) == DEGRADED
    said = json.loads(capsys.readouterr().out)
    [found] = said["problems"]
    assert (said["state"], said["received"]) == ("degraded", 7)
    assert (found["kind"], found["level"], found["words"]) == ("EndpointSilent", "warning", "arm_board is silent")
    assert found["page"] == "docs/troubleshooting/alerts.md#endpointsilent"


def test_the_line_has_the_states_of_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    mode = StateReading("mode", "MODE_AUTO", "basestation", 0.5, is_valid=True)
    with answering("", states=[mode]) as url:
        assert main(["status", "--url", url]) == OK
        assert capsys.readouterr().out == "running: mode is MODE_AUTO; 7 datagrams received\n"
        assert main(["status", "--url", url, "--json"]) == OK
    [state] = json.loads(capsys.readouterr().out)["states"]
    assert state == {"name": "mode", "value": "MODE_AUTO", "setter": "basestation", "age": 0.5, "is_valid": True}


def test_the_line_has_the_calls_of_services(capsys: pytest.CaptureFixture[str]) -> None:
    arm = ServiceReading("arm", 1, {"answered": 3, "timed_out": 2}, 0.0125, None)
    with answering("", services=[arm]) as url:
        assert main(["status", "--url", url]) == OK
        calls = "service arm: 1 open, 3 answered, 2 timed_out, median 12.5 ms, some over 5 s"
        assert capsys.readouterr().out.replace("\n", " ") == f"running: {calls}; 7 datagrams received "
        assert main(["status", "--url", url, "--json"]) == OK
    [service] = json.loads(capsys.readouterr().out)["services"]
    assert service == asdict(arm)


def test_the_line_has_the_learned_addresses(capsys: pytest.CaptureFixture[str]) -> None:
    with answering("", learned={"tablet": "10.0.0.5:9000"}) as url:
        assert main(["status", "--url", url]) == OK
        assert capsys.readouterr().out == "running: tablet is at 10.0.0.5:9000; 7 datagrams received\n"
        assert main(["status", "--url", url, "--json"]) == OK
    assert json.loads(capsys.readouterr().out)["learned"] == {"tablet": "10.0.0.5:9000"}


def test_something_else_at_the_address_is_no_router(capsys: pytest.CaptureFixture[str]) -> None:
    with answering("starting", status=503) as url:
        assert main(["status", "--url", url]) == NETWORK_FAULT
    assert capsys.readouterr().out.startswith(f"down: no router answers at {url}: {url}/health.json: 503")
