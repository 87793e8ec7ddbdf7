"""Brakes across the routes of a table: boards that may ignore them, and old commands behind them."""

from __future__ import annotations

import re

import pytest

from router.errors import Code, Diagnostic
from tests.compiler.conftest import CheckText

ENDPOINTS = (
    "{board: {address: 127.0.0.2:8, kind: board}, arm: {address: 127.0.0.4:8, kind: board},"
    " base: {address: 127.0.0.3:9000, kind: basestation}, pilot: {address: 127.0.0.5:9000, kind: tool}}"
)
ROUTES = """
routes:
  manual_drive:
    source: base
    destinations: {to}
    ttl: 200ms
    deadman: {{timeout: 500ms, send: {send}{more}}}
  manual_arm: {{source: base, destinations: [arm, pilot], deadman: {{none: not part of this test}}}}
  manual_brake: {{source: base, destinations: board, deadman: {{none: not part of this test}}}}
"""


def found(check_text: CheckText, text: str, code: Code) -> list[Diagnostic]:
    return [each for each in check_text(text, endpoints=ENDPOINTS).diagnostics if each.code is code]


@pytest.mark.parametrize(
    ("to", "send", "more", "message", "remedy"),
    [
        ("board", "{manual_drive: {}}", "", "", ""),
        ("board", "{manual_brake: {}}", "", "", ""),
        ("[board, pilot]", "{manual_brake: {}}", "", "", ""),  # the pilot may see the brake
        ("board", "{manual_arm: {}}", "", "no route sends 'manual_arm' to 'board'", "(manual_drive, manual_brake)"),
        ("board", "{manual_arm: {}}", ", because: the board takes every case", "", ""),
        ("board", "{arm_ctrl: {}}", "", "no route sends 'arm_ctrl' to 'board'", "(manual_drive, manual_brake)"),
        ("board", "{manual_drive: {}, manual_arm: {}}", "", "no route sends 'manual_arm' to 'board'", "(manual"),
        ("[board, arm]", "{manual_brake: {}, manual_arm: {}}", "", "", ""),  # each board takes one
        ("[board, arm]", "{manual_brake: {}}", "", "no route sends 'manual_brake' to 'arm'", "manual_arm)"),
        ("[board, arm]", "{arm_ctrl: {}}", "", "no route sends 'arm_ctrl' to 'board'", "(manual_drive, manual_brake)"),
        ("[board, arm]", "{manual_brake: {}, arm_ctrl: {}}", "", "no route sends 'arm_ctrl' to 'arm'", "manual_arm)"),
        ("pilot", "{manual_brake: {}}", "", "it sends to 'pilot', which is not a board", "`to: board`"),
        ("pilot", "{manual_arm: {}}", "", "it sends to 'pilot', which is not a board", "`to: arm`"),
        ("pilot", "{arm_ctrl: {}}", "", "it sends to 'pilot', which is not a board", "name boards in `to`"),
        ("pilot", "{manual_brake: {}}", ", to: board", "", ""),
        ("pilot", "{manual_brake: {}}", ", because: the pilot passes it on", "", ""),
        ("board", "{manual_brake: {}}", ", to: pilot", "'board' receives 'manual_drive' but is not in `to`", "add it"),
    ],
)  # fmt: skip
def test_a_brake_goes_to_boards_that_take_it(
    check_text: CheckText, to: str, send: str, more: str, message: str, remedy: str
) -> None:
    doubts = found(check_text, ROUTES.format(to=to, send=send, more=more), Code.DOUBTFUL_DEADMAN)
    assert len(doubts) == bool(message)
    assert all(message in each.message and remedy in each.hint for each in doubts)


def test_a_broken_route_may_be_what_sends_the_brake(check_text: CheckText) -> None:
    broken = ROUTES.format(to="board", send="{manual_brake: {}}", more="").replace(
        "destinations: board, d", "deztins: 1, d"
    )
    assert found(check_text, broken, Code.DOUBTFUL_DEADMAN) == []


DRIVE = """
routes:
  manual_drive:
    source: {source}
    destinations: {to}{more}
"""
FROM_ROS = "{topic: drive, type: comms/msg/BasestationManualDrive%s}"
LATCHED = FROM_ROS % ", qos: {durability: transient_local}"
DEADMAN = "\n    deadman: {timeout: 500ms, send: {manual_drive: {}}}"
NONE = "\n    deadman: {none: it stops by itself}"


@pytest.mark.parametrize(
    ("source", "to", "more", "message"),
    [
        ("base", "board", DEADMAN, "sent after the deadman's payload"),
        ("base", "board", DEADMAN + "\n    ttl: 500ms", ""),
        ("base", "board", DEADMAN + "\n    ttl: {none: the board checks it}", ""),
        ("base", "board", NONE, ""),
        (FROM_ROS % "", "board", DEADMAN, "sent after the deadman's payload"),
        (FROM_ROS % "", "board", NONE, ""),
        (LATCHED, "board", NONE, "the last message of 'drive' is sent to 'board' at the start"),
        (LATCHED, "[pilot, arm]", NONE, "is sent to 'arm' at the start"),
        (FROM_ROS % ", qos: best_available", "board", NONE, "at the start"),
        (FROM_ROS % ", qos: sensor_data", "board", NONE, ""),
        (LATCHED, "board", NONE + "\n    ttl: 1s", ""),
        (LATCHED, "board", NONE + "\n    ttl: {none: it is a setting}", ""),
        (LATCHED, "pilot", "", ""),
        ("base", "{endpoint: board, max_rate: 5 Hz, on_limit: latest}", DEADMAN, ""),  # an error says the same
    ],
)
def test_commands_of_any_age_are_a_warning(
    check_text: CheckText, source: str, to: str, more: str, message: str
) -> None:
    warnings = found(check_text, DRIVE.format(source=source, to=to, more=more), Code.NO_TTL)
    assert len(warnings) == bool(message)
    assert all(message in each.message for each in warnings)


@pytest.mark.parametrize(
    ("destinations", "ttl", "is_warned"),
    [("board", "", True), ("arm", "", False), ("board", "\n    ttl: 200ms", False)],
)
def test_an_old_command_disarms_no_deadman(check_text: CheckText, destinations: str, ttl: str, is_warned: bool) -> None:
    table = f"""
routes:
  manual_drive:
    source: base
    destinations: board
    ttl: 200ms
    deadman: {{timeout: 500ms, send: {{manual_drive: {{}}}}, disarmed_by: drive_motor}}
  drive_motor:
    source: base
    destinations: [{destinations}]
    deadman: {{none: it ends by itself}}{ttl}
"""
    warnings = found(check_text, table, Code.NO_TTL)
    assert ["disarm the deadman of 'manual_drive'" in each.message for each in warnings] == [True] * is_warned


CLIENTS = """
routes:
  drive_motor:
    source: {{topic: {topic}, type: comms/msg/DrivingBoardMotorMessage}}
    fields: auto
    destinations: {to}
    ttl: 200ms
    deadman: {deadman}
gateways:
  dashboard:
    transport: {{tcp: 127.0.0.1:8600}}
    inbound:
      - {{topic: /rover/drive, type: comms/msg/DrivingBoardMotorMessage{inbound}}}
"""
ROUTES_DEADMAN = "{timeout: 500ms, send: {drive_motor: {}}}"
OWN = ", deadman: {timeout: 300ms, send: {}}"


@pytest.mark.parametrize(
    ("topic", "to", "deadman", "inbound", "message"),
    [
        ("drive", "board", ROUTES_DEADMAN, "", "are sent to 'board', whatever the route's `ttl`"),
        ("/rover/drive", "board", "{none: the client has one}", "", "are sent to 'board', whatever the route's `ttl`"),
        ("/drive", "board", ROUTES_DEADMAN, "", ""),
        ("drive", "pilot", "{none: it is a copy}", "", ""),
        ("drive", "board", ROUTES_DEADMAN, ", ttl: 1s", ""),
        ("drive", "board", ROUTES_DEADMAN, ", ttl: {none: clients have no clock}", ""),
        ("/drive", "board", ROUTES_DEADMAN, OWN, "are published after the deadman's message"),
        ("/drive", "board", ROUTES_DEADMAN, f"{OWN}, ttl: 100ms", ""),
        ("/drive", "board", ROUTES_DEADMAN, f"{OWN}, ttl: {{none: clients have no clock}}", ""),
    ],
)
def test_clients_commands_of_any_age_are_a_warning(
    check_text: CheckText, topic: str, to: str, deadman: str, inbound: str, message: str
) -> None:
    text = CLIENTS.format(topic=topic, to=to, deadman=deadman, inbound=inbound)
    checked = check_text(text, node="{name: router, namespace: /rover}", endpoints=ENDPOINTS)
    warnings = [each for each in checked.diagnostics if each.code is Code.NO_TTL]
    assert not checked.has_errors
    assert len(warnings) == bool(message)
    assert all(message in each.message and "`time`" in each.hint for each in warnings)


@pytest.mark.parametrize(("timeout", "ttl"), [("5s", "200ms"), ("200ms", "200ms"), ("150ms", "150ms")])
def test_what_the_hint_proposes_ends_the_warning(check_text: CheckText, timeout: str, ttl: str) -> None:
    text = DRIVE.format(source="base", to="board", more=DEADMAN.replace("500ms", timeout))
    (warning,) = found(check_text, text, Code.NO_TTL)
    proposed = re.findall("`(ttl: [^`]+)`", warning.hint)
    assert proposed == [f"ttl: {ttl}", "ttl: {none: why}"]
    for each in proposed:
        mended = check_text(f"{text}    {each}\n", endpoints=ENDPOINTS)
        assert {finding.code for finding in mended.diagnostics} == {Code.UNCOVERED_PAYLOAD_CASE}
