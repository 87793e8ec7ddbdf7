"""`router explain --live`, and what it says of kept programs; tests/transcripts/explain*.md have what else it tells."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from router import inputs
from router.cli import OK, main
from router.compiler import check_table
from router.image.image import Image
from router.startup_image import store
from tests.acceptance.site import ROOT, wait_until
from tests.ports import free_port
from tests.routers import MODULE, start

BASE = Path(__file__).parents[1] / "bad_tables" / "base" / "base.yaml"
GATEWAYS = """\
extends: {base}
gateways:
  vr_headset: {{transport: {{udp: 127.0.0.9:8502}}, topics: {{include: [/*_data]}}}}
  net: {{transport: {{zenoh: {{key: a/b, connect: [tcp/127.0.0.1:7447]}}}}, topics: {{include: [/greeting]}}}}
"""


def test_live_shows_topics_of_the_network_with_who_publishes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.peers import Publisher

    table = tmp_path / "gateways.yaml"
    table.write_text(GATEWAYS.format(base=BASE))

    def explained(gateway: str) -> str:
        assert main(["explain", gateway, "--live", "--for", "500ms", "--table", str(table)]) == OK
        return capsys.readouterr().out

    with closing(Publisher("greeting", "std_msgs/msg/String")):
        while "~" not in (told := explained("net")):
            pass
    assert "  ~ /greeting  std_msgs/msg/String of 1  the latest value every 500 ms  by /greeting\n" in told
    assert "/imu_data  comms/msg/ImuSensorInformation, no publisher  " in explained("vr_headset")


def test_live_names_publishers_and_subscribers_of_another_type(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.peers import Publisher, Subscriber

    table = tmp_path / "gateways.yaml"
    table.write_text(GATEWAYS.format(base=BASE))
    other, ours = "geometry_msgs/msg/Twist", "comms/msg/ImuSensorInformation"

    def explained(name: str) -> str:
        assert main(["explain", name, "--live", "--for", "500ms", "--table", str(table)]) == OK
        return capsys.readouterr().out

    with closing(Subscriber("imu_data", other)), closing(Publisher("imu_data", other)):
        while "  now: " not in (told := explained("imu_info")):
            pass
        assert f"\n  now: imu_data has a subscriber of {other}; only {ours} is published\n" in told
        assert "now: imu_data has a publisher" not in told  # the route does not receive there
        while f"/imu_data  {ours}, no publisher, not {other} of 1  " not in explained("vr_headset"):
            pass
    assert "now:" not in explained("imu_info")


TABLE = """\
extends: {base}
listen: {{rover: {{address: "127.0.0.1:${{LISTEN_PORT:-{port}}}"}}}}
"""


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A table of which nothing is kept, in the working directory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(base=BASE, port=free_port()))
    return path


def keep(table: Path, *command: str) -> None:
    """Keep a program, as `router run` does with this command line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", list(command))
        with inputs.recording() as read:
            assert check_table(table).program is not None
        store.write(read.plain(), Image())


Told = Callable[[Path], list[str]]


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Told:
    """What it says of kept programs."""

    def told(table: Path) -> list[str]:
        capsys.readouterr()
        assert main(["explain", "-t", str(table)]) == OK
        return without_times(capsys.readouterr().out)

    return told


def without_times(out: str) -> list[str]:
    lines = out.rpartition("\n\n")[2].splitlines()
    return [re.sub(r"since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d [+-]\d{4}$", "since TIME", line) for line in lines]


def test_what_is_kept_of_a_table_is_told_by_command_line_and_folder(table: Path, told: Told) -> None:
    cache = table.parent / "cache/rover-router"
    nothing = [f"no program of this table is kept in {cache}: a start compiles the table first"]
    assert told(table) == nothing
    other = table.with_name("other.yaml")
    other.write_text(table.read_text())
    keep(other, "router", "run", "other.yaml")
    assert told(table) == nothing
    keep(table, "router", "run", "my table.yaml")
    assert told(table) == [
        "kept for: router run 'my table.yaml'",
        f"  in {table.parent}, since TIME",
        "  a start uses it",
    ]
    other.write_text(f"extends: {table}\n")
    keep(other, "router", "run", "other.yaml")
    assert told(table)[::3] == ["kept for: router run other.yaml", "kept for: router run 'my table.yaml'"]


def test_an_input_that_has_changed_is_named(table: Path, told: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(table, "router", "run")
    monkeypatch.setenv("LISTEN_PORT", "5001")
    assert told(table)[-1] == "  a start does not use it: the variable LISTEN_PORT has changed"
    monkeypatch.delenv("LISTEN_PORT")
    assert told(table)[-1] == "  a start uses it"
    table.write_text(f"{table.read_text()}# a comment\n")
    assert told(table)[-1] == f"  a start does not use it: the file {table} has changed"


def test_a_kept_program_of_another_python_is_told_and_not_judged(
    table: Path, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", "/opt/python")
        keep(table, "router", "run")
    assert told(table)[-1] == "  made by another Python, /opt/python: its `router explain` says whether a start uses it"


def test_a_file_that_no_start_can_use_is_named(table: Path, told: Told) -> None:
    keep(table, "router", "run")
    [path] = (table.parent / "cache/rover-router").iterdir()
    swapped = path.with_name("00000000.program")
    path.rename(swapped)
    why = "it belongs to another command line, folder or Python"
    assert told(table)[0] == f"{swapped} cannot be used as a kept program: {why}"
    swapped.write_bytes(swapped.read_bytes()[:-1])
    assert told(table)[0] == f"{swapped} cannot be used as a kept program: it is truncated"


def test_of_a_router_that_runs_it_says_what_its_next_start_does(table: Path) -> None:
    def explained() -> list[str]:
        """From another folder, where `python -m` finds modules elsewhere."""
        return without_times(start(MODULE, "explain", "-t", table, cwd=ROOT).communicate()[0])

    with start(MODULE, "run", "table.yaml", stdout=None, stderr=None) as running:
        try:
            wait_until(lambda: bool([*table.parent.glob("cache/rover-router/*.program")]), "a kept program")
            assert explained() == [
                f"kept for: {ROOT}/router/__main__.py run table.yaml",
                f"  in {table.parent}, since TIME",
                "  a start uses it",
            ]
        finally:
            running.send_signal(signal.SIGTERM)
