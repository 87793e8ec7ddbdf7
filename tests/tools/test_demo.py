"""The demo's judgement and its processes, and the demo as a whole where one of these is slow."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from demo.children import Child
from demo.expected import (
    FOUND,
    LOST,
    basestations,
    checked_table,
    command_topics,
    expected_arrivals,
    halted_boards,
    inbound_topics,
    outbound_topics,
    page_of,
    shown_topics,
)
from demo.page import Shown, look
from demo.places import alone, free_ros_domain, taken_places
from demo.recorded import Recorded, first_of
from demo.verdict import Finding, judge
from router.errors import Located
from router.table import read_table
from router.table.addresses import Address
from router.table.model import RouteTable
from router.tools.top import RouteRow, TargetRow, View
from router.tools.udp import open_udp
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.tables import ROUTES

ROOT = Path(__file__).parent.parent.parent
MORE = """\
extends: {routes}/sim.yaml
endpoints:
  pit: {{address: "127.0.0.12:29000", kind: basestation}}
  stands: {{address: "127.0.0.13:29000", kind: basestation}}
routes: {{manual_arm: {{source: [pit]}}}}
gateways: {{laptop: {{transport: {{tcp: "127.0.0.1:28766"}}}}}}
"""
SLOW_TALKER = """\
import sys, time
if "demo.ros_talker" in sys.orig_argv:
    time.sleep(1.5)
"""
"""A `sitecustomize`. If commands were timed from the talker's start, they would last into the lost link by so much."""

WHOLE = """\
import sys
from pathlib import Path
import demo.processes
demo.processes.TABLE = Path("tests/rover/routes/sim.yaml")
from demo.__main__ import main
sys.exit(main())
"""
LASTING = "import time\nprint('{\"ready\": true}', flush=True)\ntime.sleep(60)\n"


def seen(dropped: dict[str, int] | None = None, rejected: dict[str, int] | None = None, kernel_drops: int = 0) -> View:
    row = RouteRow("imu_info", 9, 1.0, (TargetRow("imu_data", True, 9, 1.0, dropped or {}, 0),))
    return View((row,), 9, 1.0, rejected or {}, kernel_drops)


SAVED = Recorded(Path("recordings/sim_deadman-manual_drive.mcap"), 700)


class Witnesses:
    """What all of them tell of a demo in which everything arrived and nothing was lost."""

    def __init__(self, table: RouteTable) -> None:
        self.table = table
        self.heard: dict[str, Any] = {"topics": {topic: {"count": 3} for topic in inbound_topics(table)}}
        self.received: dict[str, dict[str, Any]] = {}
        for endpoint, case in expected_arrivals(table):
            self.received.setdefault(endpoint, {})[case] = {"count": 3}
        self.changes = [
            {"at": at, "board": board, "state": state, "text": state}
            for at, state in ((0.1, "obeying"), (LOST + 0.5, "halted"), (FOUND + 0.1, "obeying"))
            for board in ("driving_board", "arm_board")
        ]
        self.frames = {"complete": 5, "incomplete": 0, "astray": 0}
        self.view = seen()
        self.shown = Shown(True, frozenset(shown_topics(table)) | {"/rosout"})
        self.recorded: Recorded | None = SAVED

    def judged(self) -> list[Finding]:
        frames = {"basestation": {"detected_object": self.frames}}
        arrived = {"received": self.received, "undecodable": {}, "changes": self.changes, "frames": frames}
        return list(judge(self.table, self.heard, arrived, self.view, self.shown, self.recorded))

    def forget(self, change: int) -> None:
        self.changes = [each for each in self.changes if each != self.changes[change]]

    def tell(self, **other: object) -> None:
        for name, value in other.items():
            setattr(self, name, value)

    def show(self, **other: Any) -> None:
        self.shown = self.shown._replace(**other)


@pytest.fixture(scope="module")
def sim_table() -> RouteTable:
    return checked_table(ROUTES / "sim.yaml")


def test_all_is_well_when_everything_arrived_and_nothing_was_lost(sim_table: RouteTable) -> None:
    witnesses = Witnesses(sim_table)
    witnesses.view = seen(dropped={"rate_limited": 5, "stale": 1})
    *findings, losses = witnesses.judged()
    assert all(finding.ok for finding in (*findings, losses))
    assert losses.text.endswith("lost none; dropped as the table says: 1 stale, 5 rate_limited")


CUT = f"the link to basestation was cut from {LOST:.0f} to {FOUND:.0f} s, and "


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda told: told.heard["topics"]["imu/mag"].update(count=0), "ROS topics: imu/mag"),
        (
            lambda told: told.received["driving_board"].pop("manual_drive"),
            "manual_drive at driving_board",
        ),
        (lambda told: told.received["driving_board"].pop("drive_motor"), "drive_motor at driving_board"),
        (lambda told: told.frames.update(complete=0), "basestation reassembled 0 frames of detected_object"),
        (lambda told: told.forget(2), f"{CUT}driving_board was not halted"),
        (lambda told: told.forget(4), f"{CUT}driving_board did not obey again"),
        (lambda told: told.tell(view=seen(dropped={"queue_full": 2})), "lost messages: 2 queue_full"),
        (lambda told: told.tell(view=seen(rejected={"malformed": 1})), "lost messages: 1 malformed"),
        (lambda told: told.tell(view=seen(kernel_drops=4)), "the router lost messages: 4 kernel_drops"),
        (lambda told: told.tell(shown=Shown()), "the dashboard's page or websocket cannot be reached"),
        (lambda told: told.show(topics=told.shown.topics - {"/imu/mag"}), "page got nothing for /imu/mag"),
        (lambda told: told.show(early=frozenset({"/imu/mag"})), "page got data before its schema: /imu/mag"),
        (lambda told: told.tell(recorded=None), "the datagrams before the halt were not recorded"),
        (lambda told: told.tell(recorded=Recorded(Path("empty.mcap"), 0)), "halt were not recorded"),
    ],
)
def test_one_fault_is_one_complaint(
    sim_table: RouteTable, spoil: Callable[[Witnesses], object], complaint: str
) -> None:
    witnesses = Witnesses(sim_table)
    spoil(witnesses)
    [told] = [finding.text for finding in witnesses.judged() if not finding.ok]
    assert told.endswith(complaint)


def test_silence_of_the_witnesses_fails(sim_table: RouteTable) -> None:
    assert sum(not finding.ok for finding in judge(sim_table, {}, {}, seen(), None, SAVED)) == 4
    assert first_of([]) is None  # of no file


def test_both_directions_are_expected(sim_table: RouteTable) -> None:
    """Every case from ROS, and nothing that the router itself publishes among what the talker says."""
    from_ros = {route.case.value for route in sim_table.routes if route.is_outbound}
    assert from_ros <= {case for _, case in expected_arrivals(sim_table)}
    assert not outbound_topics(sim_table).keys() & inbound_topics(sim_table).keys()


def test_the_software_knows_what_it_must_leave_to_the_operator(sim_table: RouteTable) -> None:
    """What takes over from the operator would keep the deadmen from tripping."""
    assert command_topics(sim_table) == {"drive_motor", "arm_ctrl", "arm_target"}


def test_a_page_that_nobody_serves_shows_nothing() -> None:
    assert look(Address("127.0.0.1", free_port(kind=socket.SOCK_STREAM)), {"/imu/mag"}) == Shown()


def test_a_table_with_more_basestations_and_gateways_is_judged_as_well(tmp_path: Path) -> None:
    """All who command are cut off, for one of them alone would keep the deadmen from tripping; `stands` only looks."""
    (tmp_path / "table.yaml").write_text(MORE.format(routes=ROUTES))
    table = read_table(tmp_path / "table.yaml")
    assert basestations(table) == ["basestation", "pit"]
    assert halted_boards(table) == {"driving_board", "arm_board"}
    others_first = replace(table, gateways=dict(reversed([*table.gateways.items()])))
    assert page_of(others_first) == page_of(table) == Address("127.0.0.1", 28765)


def test_addresses_that_are_taken_are_named(table: RouteTable) -> None:
    assert taken_places(table) == []
    with open_udp(table.endpoints["board"].address.value, "other"):
        (problem,) = taken_places(table)
    assert problem.startswith("endpoint board: cannot bind 127.0.6.30:")


def test_a_port_of_a_gateway_that_is_taken_is_named(table: RouteTable, sim_table: RouteTable) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = Address(*other.getsockname())
        dashboard = sim_table.gateways["dashboard"]
        listens = Located(address, dashboard.span)
        beside = replace(table, gateways={"dashboard": replace(dashboard, address=listens)})
        assert page_of(beside) == address
        assert taken_places(beside) == [f"gateway dashboard: another process has TCP port {address}"]
    assert taken_places(beside) == []


def test_a_ros_domain_with_a_participant_is_not_free() -> None:
    domain = free_ros_domain()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * domain))
        assert all(free_ros_domain() != domain for _ in range(200))


@pytest.fixture
def lasting(tmp_path: Path) -> dict[str, str]:
    """The environment in which the module `lasting` prints one JSON line and then stays for a minute."""
    (tmp_path / "lasting.py").write_text(LASTING)
    return os.environ | {"PYTHONPATH": f"{ROOT}:{tmp_path}"}


def test_a_child_is_read_and_ended(lasting: dict[str, str]) -> None:
    child = Child("lasting", lasting, "lasting")
    wait_until(lambda: bool(child.latest))
    assert (child.latest, child.exit_code) == ({"ready": True}, None)
    child.end()
    assert child.exit_code == -signal.SIGTERM


def test_the_last_words_of_a_child_that_fails_are_kept(lasting: dict[str, str]) -> None:
    child = Child("none", lasting, "no_such_module")
    wait_until(lambda: child.exit_code is not None)
    assert child.exit_code == 1
    assert "no_such_module" in child.last_words()
    child.end()


def is_running(pid: int) -> bool:
    """Not gone, and no zombie that its new parent has yet to bury."""
    status = Path(f"/proc/{pid}/status")
    try:
        return "State:\tZ" not in status.read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_children_do_not_outlive_a_parent_that_is_killed(lasting: dict[str, str]) -> None:
    program = (
        "import os, sys\nfrom demo.children import Child\n"
        "child = Child('lasting', os.environ, 'lasting')\n"
        "while not child.latest: pass\n"
        "print(child._process.pid, flush=True)\nsys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], env=lasting, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.kill()
        parent.wait()
    wait_until(lambda: not is_running(pid))


@pytest.mark.slow
@pytest.mark.skipif(find_spec("rclpy") is None or find_spec("comms") is None, reason="needs ROS 2 and comms")
def test_a_slow_start_of_the_software_changes_nothing(tmp_path: Path) -> None:
    if (wrapper := alone()) is None:
        pytest.skip("needs a network namespace")
    (tmp_path / "sitecustomize.py").write_text(SLOW_TALKER)
    folders = (str(tmp_path), os.environ.get("PYTHONPATH"))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, folders)), "RECORDINGS": str(tmp_path)}
    command = [*wrapper, sys.executable, "-c", WHOLE]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_child_reads_what_it_is_told(tmp_path: Path) -> None:
    (tmp_path / "echoing.py").write_text("import json\nprint(json.dumps({'told': input()}), flush=True)\n")
    child = Child("echoing", os.environ | {"PYTHONPATH": f"{ROOT}:{tmp_path}"}, "echoing")
    child.tell("12.5")
    wait_until(lambda: bool(child.latest))
    assert child.latest == {"told": "12.5"}
    wait_until(lambda: child.exit_code is not None)
    child.tell("nobody reads this")
    child.end()
    assert child.exit_code == 0
