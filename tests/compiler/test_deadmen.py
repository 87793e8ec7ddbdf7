"""Deadmen: which routes need one, and what it may send to whom."""

from __future__ import annotations

import pytest

from router.errors import Code, Diagnostic
from tests.compiler.conftest import CheckText

ROUTE = """
routes:
  manual_drive:
    source: base
    destinations: [{destinations}]
    deadman: {deadman}
"""
BRAKE = "{timeout: 500ms, send: {manual_drive: {}}, to: [board]}"
APART = (Code.UNCOVERED_PAYLOAD_CASE, Code.NO_TTL)
"""Findings about the rest of a table."""


def findings(check_text: CheckText, destinations: str, deadman: str) -> list[Diagnostic]:
    found = check_text(ROUTE.format(destinations=destinations, deadman=deadman)).diagnostics
    return [finding for finding in found if finding.code not in APART]


def test_one_warning_for_each_route_that_commands_boards(check_text: CheckText) -> None:
    routes = """
    routes:
      manual_drive: {source: base, destinations: [board, other]}
      manual_brake:
        {source: {topic: a, type: std_msgs/msg/Bool}, fields: {brake: data}, destinations: [board]}
      manual_arm: {source: board, destinations: [base]}
      arm_ctrl: {ignore: not part of this test}
      arm_target: {source: base, destinations: [board], deadman: {none: the board knows when it is there}}
    """
    endpoints = (
        "{board: {address: 127.0.0.2:8, kind: board}, other: {address: 127.0.0.4:8, kind: board},"
        " base: {address: 127.0.0.3:9000, kind: basestation}}"
    )
    found = [each for each in check_text(routes, endpoints=endpoints).diagnostics if each.code is Code.NO_DEADMAN]
    assert [each.message for each in found] == [
        "nothing stops 'board' when 'manual_drive' stops arriving",
        "nothing stops 'board' when 'manual_brake' stops arriving",
    ]


def test_deadman_that_is_written_wrong_is_not_missing_as_well(check_text: CheckText) -> None:
    found = findings(check_text, "board", "{timeout: 500, send: {manual_brake: {brake: true}}, to: [board]}")
    assert [each.code for each in found] == [Code.WRONG_TYPE]


@pytest.mark.parametrize(
    ("send", "envelopes"),
    [
        ("manual_brake: {brake: true}", ["ca01020801"]),
        ("manual_arm: {}", ["d20100"]),
        ("manual_arm: {}, manual_brake: {brake: true}", ["d20100", "ca01020801"]),
        ("manual_brake: {brake: true}, manual_arm: {}", ["ca01020801", "d20100"]),
    ],
)
def test_payloads_are_known_before_the_start(check_text: CheckText, send: str, envelopes: list[str]) -> None:
    deadman = f"{{timeout: 500ms, send: {{{send}}}, to: [board, base]}}"
    checked = check_text(ROUTE.format(destinations="board", deadman=deadman))
    (route,) = checked.routes
    assert not checked.has_errors
    assert route.deadman is not None
    sent = [(to, [each.hex() for each in datagrams]) for to, datagrams in route.deadman.datagrams]
    assert sent == [("board", envelopes), ("base", envelopes)]


@pytest.mark.parametrize(
    ("send", "to", "code", "at"),
    [
        ("manual_brake: {}, manual_break: {}", "board", Code.UNKNOWN_PAYLOAD_CASE, "manual_break"),
        ("manual_brake: {}, manual_arm: {speeds: 1}", "board", Code.UNKNOWN_FIELD, "speeds"),
        ("manual_brake: {}, manual_arm: {speed: 1 / 0}", "board", Code.OUT_OF_RANGE, "1 / 0"),
        ("manual_brake: {}, manual_drive: {}", "bord", Code.UNKNOWN_ENDPOINT, "bord"),
    ],
)
def test_each_payload_is_checked(check_text: CheckText, send: str, to: str, code: Code, at: str) -> None:
    deadman = f"{{timeout: 500ms, send: {{{send}}}, to: [{to}]}}"
    found = [each for each in findings(check_text, "board", deadman) if each.code is not Code.DOUBTFUL_DEADMAN]
    text = ROUTE.format(destinations="board", deadman=deadman)
    assert [(each.code, f"'{at}'" in each.message or text.count(at) == 1) for each in found] == [(code, True)]


TURNS = """
routes:
  manual_drive:
    source: base
    destinations: [board]
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}, to: [{to}], disarmed_by: [{cases}]}}
  drive_motor:
    source: {{topic: drive, type: comms/msg/DrivingBoardMotorMessage}}
    fields: auto
    destinations: [tool, board]
    deadman: {{none: it stops by itself}}
  manual_brake: {{source: base, destinations: [tool], deadman: {{none: it stops by itself}}}}
  arm_ctrl: {{ignore: not part of this test}}
"""
THREE = (
    "{board: {address: 127.0.0.2:8, kind: board}, base: {address: 127.0.0.3:9000, kind: basestation},"
    " tool: {address: 127.0.0.4:9000, kind: tool}}"
)


def test_hand_over_concerns_what_goes_to_the_endpoints_of_the_deadman(check_text: CheckText) -> None:
    checked = check_text(TURNS.format(to="board", cases="drive_motor"), endpoints=THREE)
    assert not checked.has_errors
    routes = {checked.route.name: checked for checked in checked.routes}
    deadman, (feed,) = routes["manual_drive"].deadman, routes["drive_motor"].subscriptions
    assert deadman is not None
    assert deadman.disarmed_by == ("drive_motor",)
    assert [served.deadmen for served in routes["manual_drive"].targets] == [("manual_drive",)]
    assert {served.label: served.deadmen for served in feed.targets} == {
        "tool": (),
        "board": ("manual_drive",),
    }


@pytest.mark.parametrize(
    ("to", "cases", "codes"),
    [
        ("board", "drive_motor", []),
        ("base", "drive_motor", [Code.BAD_VALUE]),
        ("base, tool", "drive_motor, manual_brake", []),
        ("board", "manual_brake", [Code.BAD_VALUE]),
        ("board", "manual_drive", [Code.BAD_VALUE]),
        ("board", "arm_ctrl", [Code.BAD_VALUE]),
        ("board", "arm_target", [Code.BAD_VALUE]),
        ("board", "drive_moto", [Code.UNKNOWN_PAYLOAD_CASE]),
        ("bord", "drive_motor", [Code.UNKNOWN_ENDPOINT]),
    ],
)
def test_only_who_commands_the_same_endpoint_can_take_over(
    check_text: CheckText, to: str, cases: str, codes: list[Code]
) -> None:
    found = check_text(TURNS.format(to=to, cases=cases), endpoints=THREE).diagnostics
    apart = {*APART, Code.DOUBTFUL_DEADMAN}  # it need not stop the board here
    assert [finding.code for finding in found if finding.code not in apart] == codes


def test_a_broken_route_is_not_blamed_for_what_it_would_take_over(check_text: CheckText) -> None:
    table = TURNS.format(to="board", cases="drive_motor").replace("[tool, board]", "[tool, 5]")
    found = check_text(table, endpoints=THREE).diagnostics
    assert Code.BAD_VALUE not in {finding.code for finding in found}


ROBOTS = """
routes:
  manual_drive:
    - source: {{topic: a, type: std_msgs/msg/Int8}}
      fields: {{forward_backward: data, turn: {first}}}
      destinations: [board]
      deadman: {{timeout: 500ms, send: {{manual_drive: {{}}}}{disarmed_by}}}
    - source: {{topic: b, type: std_msgs/msg/Int8}}
      fields: {{forward_backward: data, turn: {second}}}
      destinations: [board]
      deadman: {{timeout: 500ms, send: {{manual_drive: {{}}}}{of_second}}}
"""
FROM_SECOND, FROM_FIRST = "manual_drive_from_ros_2", "manual_drive_from_ros"


@pytest.mark.parametrize(
    ("first", "second", "hint"),
    [
        ("0", "1", "add `disarmed_by: []` if they move other motors, as 'turn' suggests"),
        ("-1", "1 - 1", "add `disarmed_by: []` if they move other motors, as 'turn' suggests"),
        ("1", "2 - 1", "add `disarmed_by: manual_drive_from_ros_2` if they take over"),
        ("data", "1", "add `disarmed_by: manual_drive_from_ros_2` if they take over"),
    ],
)
def test_routes_of_one_case_that_set_a_field_differently_move_different_things(
    check_text: CheckText, first: str, second: str, hint: str
) -> None:
    """For example two robots behind one address, of which each has a number."""
    table = ROBOTS.format(first=first, second=second, disarmed_by="", of_second=", disarmed_by: []")
    [found] = [each for each in check_text(table).diagnostics if each.code is Code.DOUBTFUL_DEADMAN]
    assert found.hint.startswith(hint)
    assert FROM_SECOND in found.hint


@pytest.mark.parametrize(
    ("name", "disarms", "codes"),
    [
        (FROM_SECOND, [FROM_SECOND, FROM_FIRST], []),
        ("manual_drive", [FROM_SECOND, FROM_FIRST], []),
        (FROM_FIRST, [FROM_SECOND], [Code.BAD_VALUE, Code.DOUBTFUL_DEADMAN]),
        ("manual_drive_from_ros_3", [FROM_SECOND], [Code.UNKNOWN_PAYLOAD_CASE, Code.DOUBTFUL_DEADMAN]),
    ],
)
def test_routes_may_take_over_by_their_names(
    check_text: CheckText, name: str, disarms: list[str], codes: list[Code]
) -> None:
    table = ROBOTS.format(first=0, second=0, disarmed_by=f", disarmed_by: {name}", of_second=", disarmed_by: []")
    checked = check_text(table)
    assert {each.code for each in checked.diagnostics} - {*APART} == {*codes}
    second = checked.routes[1].subscriptions[0].targets[0]
    assert [second.deadmen] == [tuple(disarms)]


def test_a_route_whose_deadman_leaves_the_board_alone_is_not_proposed_to_take_over(check_text: CheckText) -> None:
    """Disarmed by its commands, no deadman would stop the board."""
    arm = "timeout: 500ms, send: {manual_arm: {}}, to: tool, because: it is a test"
    table = BESIDE.format(destinations="board", drive="", arm=arm)
    [found] = [each for each in check_text(table, endpoints=THREE).diagnostics if each.code is Code.DOUBTFUL_DEADMAN]
    assert found.hint == (
        "add `disarmed_by: []` if they move other motors; if 'manual_arm' takes over from 'manual_drive', first add "
        "'board' to `to` of its deadman, which does not stop it"
    )


def test_a_deadman_has_room_for_the_endpoints_that_it_stops(check_text: CheckText) -> None:
    for count, codes in ((64, []), (65, [Code.BAD_VALUE])):
        boards = [f"b{number}" for number in range(count)]
        endpoints = ", ".join(f"{name}: {{address: 127.0.1.{at}:8, kind: board}}" for at, name in enumerate(boards))
        table = ROUTE.format(destinations=", ".join(boards), deadman="{timeout: 500ms, send: {manual_drive: {}}}")
        found = check_text(table, endpoints=f"{{{endpoints}, base: {{address: 127.0.0.3:9000, kind: basestation}}}}")
        assert {each.code for each in found.diagnostics} - {*APART} == {*codes}


@pytest.mark.parametrize("value", ["brake", "message", "source == 'base'", "received_at > 0", "turn > 0", "has(turn)"])
def test_payload_is_made_of_constants(check_text: CheckText, value: str) -> None:
    deadman = f'{{timeout: 500ms, send: {{manual_brake: {{brake: "{value}"}}}}, to: [board]}}'
    (finding,) = findings(check_text, "board", deadman)
    assert finding.code is Code.UNKNOWN_FIELD
    assert "is not a constant" in finding.message


@pytest.mark.parametrize(
    ("destinations", "timeout", "trips"),
    [
        ("{endpoint: board, max_rate: 10 Hz}", "100ms", True),
        ("{endpoint: board, max_rate: 10 Hz}", "101ms", False),
        ("{endpoint: board, max_rate: 10 Hz}, {endpoint: tool, max_rate: 2 Hz}", "101ms", False),
        ("{endpoint: board, max_rate: 10 Hz}, tool", "10ms", True),  # what the tool gets is no command
        ("board, {endpoint: tool, max_rate: 10 Hz}", "10ms", False),
    ],
)
def test_deadman_does_not_trip_by_itself(check_text: CheckText, destinations: str, timeout: str, trips: bool) -> None:
    endpoints = (
        "{board: {address: 127.0.0.2:8, kind: board}, base: {address: 127.0.0.3:9000, kind: basestation},"
        " tool: {address: 127.0.0.4:9000, kind: tool}}"
    )
    routes = ROUTE.format(destinations=destinations, deadman=BRAKE.replace("500ms", timeout))
    found = check_text(routes, endpoints=endpoints).diagnostics
    assert (Code.BAD_VALUE in {finding.code for finding in found}) == trips


@pytest.mark.parametrize(("repeat", "accepted"), [("9ms", False), ("10ms", True)])
def test_a_deadman_floods_nobody(check_text: CheckText, repeat: str, accepted: bool) -> None:
    deadman = f"{{timeout: 500ms, send: {{manual_drive: {{}}}}, to: [board], repeat: {repeat}}}"
    assert [each.code for each in findings(check_text, "board", deadman)] == ([] if accepted else [Code.BAD_VALUE])


@pytest.mark.parametrize(
    ("destination", "ttl", "accepted"),
    [
        ("{endpoint: board, max_rate: 10 Hz, on_limit: latest}", None, False),
        ("{endpoint: board, max_rate: 10 Hz, on_limit: latest}", "501ms", False),
        ("{endpoint: board, max_rate: 10 Hz, on_limit: latest}", "500ms", True),
        ("{endpoint: board, max_rate: 10 Hz, on_limit: first}", None, True),
        ("paced", None, False),
        ("paced", "200ms", True),
    ],
)
def test_no_command_waits_until_after_the_deadman_has_tripped(
    check_text: CheckText, destination: str, ttl: str | None, accepted: bool
) -> None:
    deadman = BRAKE.replace("[board]", "[board, paced]")
    route = ROUTE.format(destinations=destination, deadman=deadman) + (f"    ttl: {ttl}\n" if ttl else "")
    endpoints = (
        "{board: {address: 127.0.0.2:8, kind: board}, base: {address: 127.0.0.3:9000, kind: basestation},"
        " paced: {address: 127.0.0.4:8, kind: board, bandwidth: 10kB/s}}"
    )
    found = check_text(route, endpoints=endpoints).diagnostics
    apart = {*APART, Code.DOUBTFUL_DEADMAN}  # one of the boards gets no commands
    codes = [finding.code for finding in found if finding.code not in apart]
    assert codes == ([] if accepted else [Code.BAD_VALUE])


@pytest.mark.parametrize(
    ("deadman", "ttl", "doubts"),
    [
        ("timeout: 10s", "10s", 0),
        ("timeout: 10001ms", "1s", 1),
        ("timeout: 20ms", "20ms", 0),
        ("timeout: 19999us", "19ms", 1),
        ("timeout: 200ms, repeat: 400ms", "200ms", 0),
        ("timeout: 200ms, repeat: 401ms", "200ms", 1),
        ("timeout: 30ms, repeat: 100ms", "30ms", 0),
        ("timeout: 200ms", "201ms", 1),
        ("timeout: 1ms, repeat: 101ms, to: base", "1s", 4),
        ("timeout: 1ms, repeat: 101ms, to: base, because: it is a test", "1s", 0),
    ],
)
def test_what_looks_like_a_mistake_is_a_warning_unless_a_reason_stands_there(
    check_text: CheckText, deadman: str, ttl: str, doubts: int
) -> None:
    route = ROUTE.format(destinations="board", deadman=f"{{{deadman}, send: {{manual_drive: {{}}}}}}")
    found = check_text(f"{route}    ttl: {ttl}\n").diagnostics
    codes = [finding.code for finding in found if finding.code not in APART]
    assert codes == doubts * [Code.DOUBTFUL_DEADMAN]


BESIDE = """
routes:
  manual_drive:
    source: base
    destinations: [{destinations}]
    deadman: {{timeout: 500ms, send: {{manual_drive: {{}}}}{drive}}}
  manual_arm:
    source: base
    destinations: [board]
    deadman: {{{arm}}}
"""
ARM = "timeout: 500ms, send: {manual_arm: {}}"


@pytest.mark.parametrize(
    ("destinations", "drive", "arm", "places"),
    [
        ("board", "", ARM, ["manual_arm", "manual_drive"]),
        ("board", ", disarmed_by: manual_arm", ARM, ["manual_drive"]),
        ("board", ", disarmed_by: manual_arm", f"{ARM}, disarmed_by: []", []),
        ("board", ", disarmed_by: []", f"{ARM}, because: it is a test", []),
        ("board", ", disarmed_by: manual_arm", f"{ARM}, disarmed_by: manual_drive", []),
        ("board", "", "none: it stays where it is", []),
        ("tool", "", ARM, []),
    ],
)
def test_deadmen_of_one_board_know_each_other(
    check_text: CheckText, destinations: str, drive: str, arm: str, places: list[str]
) -> None:
    """Else one cuts into commands of the other route: `places` are the cases of these."""
    table = BESIDE.format(destinations=destinations, drive=drive, arm=arm)
    messages = [each.message for each in check_text(table, endpoints=THREE).diagnostics]
    assert [each for each in messages if "interrupt" in each] == [
        f"the deadman would interrupt commands of '{case}', which 'board' also receives" for case in places
    ]
