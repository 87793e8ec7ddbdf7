"""Endpoints as targets: how the endpoint, the route and the destination decide what is sent when."""

from __future__ import annotations

import pytest

from router.compiler.checked import Target
from router.table.model import Keep, Priority
from tests.compiler.conftest import CheckText

ENDPOINTS = (
    "{board: {address: 127.0.0.2:8, kind: board, trim_trailing_zeros: true},"
    " base: {address: 127.0.0.3:9000, kind: basestation, budget: 1kB/s},"
    " tool: {address: 127.0.0.4:9000, kind: tool}}"
)
INBOUND = """
routes:
  manual_brake:
    source: tool{priority}
    destinations: [board, {{endpoint: base, max_rate: 5 Hz, keep: latest}}]
    deadman: not part of this test
"""
OUTBOUND = """
routes:
  manual_brake:
    source: ros{priority}
    topics: [{{topic: a, type: std_msgs/msg/Bool}}]
    fields: {{brake: data}}
    destinations: [board, {{endpoint: base, max_rate: 5 Hz, keep: latest}}]
    deadman: not part of this test
"""


def targets(check_text: CheckText, routes: str, priority: str = "") -> tuple[Target, Target]:
    said = f"\n    priority: {priority}" if priority else ""
    (route,) = check_text(routes.format(priority=said), endpoints=ENDPOINTS).routes
    board, base = [*route.targets, *(target for feed in route.feeds for target in feed.targets)]
    return board.target, base.target


@pytest.mark.parametrize("routes", [INBOUND, OUTBOUND], ids=["inbound", "outbound"])
def test_what_goes_to_a_board_is_a_command_where_the_route_says_nothing(check_text: CheckText, routes: str) -> None:
    assert [target.priority for target in targets(check_text, routes)] == [Priority.COMMAND, Priority.TELEMETRY]
    assert [target.priority for target in targets(check_text, routes, "bulk")] == [Priority.BULK, Priority.BULK]


@pytest.mark.parametrize("routes", [INBOUND, OUTBOUND], ids=["inbound", "outbound"])
def test_target_has_what_its_endpoint_and_its_destination_say(check_text: CheckText, routes: str) -> None:
    board, base = targets(check_text, routes)
    assert (board.trim, board.has_budget, board.max_rate, board.keep) == (True, False, None, Keep.FIRST)
    assert (base.trim, base.has_budget, base.max_rate, base.keep) == (False, True, 5, Keep.LATEST)


def test_payload_is_made_for_ros_and_forwarded_from_udp(check_text: CheckText) -> None:
    assert [target.plan is None for target in targets(check_text, INBOUND)] == [True, True]
    assert [target.plan is None for target in targets(check_text, OUTBOUND)] == [False, False]
