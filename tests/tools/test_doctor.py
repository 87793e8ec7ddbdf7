"""The doctor on real sockets and real metrics: what it finds, how grave that is, and what to do about it."""

from __future__ import annotations

import os
import re
import shutil
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from datetime import datetime, timezone
from pathlib import Path
from types import SimpleNamespace

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.errors import StartError
from router.observe.problems import Kind, Problem
from router.recording.writer import RecordingDirectory
from router.table.addresses import Address
from router.table.model.endpoints import Endpoint
from router.tools import doctor_checks, name_checks
from router.tools.doctor import before_start, examine
from router.tools.doctor_checks import (
    CheckResult,
    Grade,
    carrier,
    clock,
    endpoints,
    fine,
    listeners,
    open_domain,
    page,
    ports,
    problem,
    receive_buffers,
    recordings,
    ros,
    ros_peers,
    shared_memory,
    warning,
)
from router.tools.name_checks import Names
from router.tools.udp import open_udp
from tests.ports import free_port
from tests.tools.answering import answering

ROOT = Path(__file__).parent.parent.parent

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: "127.0.0.1:{listen}", receive_buffer: {buffer}}}}}
endpoints:
  sensor_board: {{address: "127.0.0.30:8", kind: board, stale_after: 5s}}
  arm_board: {{address: "127.0.0.40:8", kind: board, stale_after: never}}
  basestation: {{address: "127.0.0.10:9000", kind: basestation}}
routes:
  ph_info: {{source: sensor_board, destinations: [basestation]}}
  arm_diag: {{source: arm_board, destinations: [basestation]}}
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    metrics, listen = free_port(kind=socket.SOCK_STREAM), free_port()
    path.write_text(TABLE.format(root=ROOT, metrics=metrics, listen=listen, buffer="64KiB"))
    return path


def compiled(table: Path) -> CompiledTable:
    program = check_table(table).program
    assert program is not None
    return program


def texts(found: list[CheckResult], grade: Grade) -> list[str]:
    return [finding.text for finding in found if finding.grade is grade]


def rewritten(table: Path, old: str, new: str) -> CompiledTable:
    table.write_text(table.read_text().replace(old, new))
    return compiled(table)


def gist(found: Iterable[CheckResult], text: str = "") -> list[tuple[Grade, bool]]:
    """The grades, and whether each result says this."""
    return [(each.grade, text in each.text) for each in found]


def test_a_sound_place_has_no_problem(table: Path) -> None:
    found = list(examine(table, {}))
    assert texts(found, Grade.PROBLEM) == []
    assert {finding.about for finding in found} >= {"table", "ports", "buffers", "clock", "endpoints", "router"}
    assert all(finding.remedy for finding in found if finding.grade is not Grade.FINE)


def test_message_types_are_counted(table: Path) -> None:
    topic = "topic: {topic: ph, type: std_msgs/msg/Float32, fields: {data: ph_value}}"
    program = rewritten(table, "[basestation]}\n  arm", f"[basestation], {topic}}}\n  arm")
    [found] = ros(program)
    assert found.text.endswith(", and 1 message type of the table")


def test_what_a_router_would_meet_in_its_ros_domain_is_said_before_its_start(table: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from router.ros.marks import this_router
    from tests.ros.peers import Publisher, wait_until
    from tests.ros.test_graph import OtherRouter

    def of_ros(look: Callable[[Path, Mapping[str, str]], Iterator[CheckResult]]) -> list[str]:
        return [each.text for each in look(table, {}) if each.about == "ROS" and each.grade is Grade.WARNING]

    route = "ph_info: {source: {topic: greeting, type: std_msgs/msg/Float32}, fields: {ph_value: data}, "
    rewritten(table, "ph_info: {source: sensor_board, ", route)
    with (
        closing(OtherRouter("--ros-args", "-r", "__node:=rover_router")) as router,
        closing(Publisher("greeting", "geometry_msgs/msg/Twist")),
    ):
        who = f"process {router.process.pid} on {this_router().host}"
        met = [
            f"another router runs, {who}: it has the name of its node and takes messages from greeting",
            "greeting has a publisher of geometry_msgs/msg/Twist; only std_msgs/msg/Float32 is received",
        ]
        wait_until(lambda: of_ros(before_start) == met)  # discovery may take longer on a busy computer
        wait_until(lambda: set(met) <= set(of_ros(examine)))
        rewritten(table, next(line for line in table.read_text().splitlines() if line.startswith("http: ")), "")
        of_any_table: list[CheckResult] = []

        def is_met() -> bool:
            of_any_table[:] = [each for each in ros_peers(compiled(table)) if who in each.text]
            return bool(of_any_table)

        wait_until(is_met)
        assert of_any_table[0].text.startswith(f"a router runs, {who}: it has the name of its node")
        assert of_any_table[0].remedy.startswith("if it runs this table, add an `http.address`")
    assert of_ros(before_start) == []


def test_without_the_right_to_a_real_time_priority_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(doctor_checks, "load", lambda: None)
    monkeypatch.setattr(os, "sched_setscheduler", refused)
    found = list(carrier())
    assert [each.grade for each in found] == [Grade.FINE, Grade.WARNING]
    assert "rtprio 1" in found[1].remedy


def test_asking_for_a_real_time_priority_leaves_the_one_that_was_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_checks, "load", lambda: None)
    before = os.sched_getscheduler(0)
    assert len(list(carrier())) == len(("library", "priority"))
    assert os.sched_getscheduler(0) == before


def test_a_library_that_cannot_be_used_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise StartError("libcarrier.so was not built, and nothing runs without it", "run 'make setup'")

    monkeypatch.setattr(doctor_checks, "load", missing)
    [found] = carrier()
    assert (found.grade, found.remedy) == (Grade.PROBLEM, "run 'make setup'")


def test_a_port_that_somebody_has_is_told_with_his_name_and_may_be_the_services(
    table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = compiled(table)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(address := program.listeners[0].address.value)
        holder = f"(pid {os.getpid()}) has udp port {address.port}"
        assert gist(ports(program, running=False), holder) == [(Grade.PROBLEM, True)]
        assert gist(ports(program, running=False, with_listeners=False), "free: ") == [(Grade.FINE, True)]
        monkeypatch.setattr(doctor_checks, "port_holder", lambda *_: "systemd (pid 1)")
        assert gist(ports(program, running=False), "systemctl start rover-router") == [(Grade.FINE, True)]
    assert gist(ports(program, running=False), "free: ") == [(Grade.FINE, True)]


def test_a_port_of_ipv4_is_free_for_ipv6_until_somebody_has_that(table: Path) -> None:
    port = free_port("::")
    program = rewritten(table, "listen: {", f'listen: {{six: {{address: "[::]:{port}"}}, ')
    with open_udp(Address("0.0.0.0", port), "IPv4"):
        assert gist(ports(program, running=False), f", [::]:{port}") == [(Grade.FINE, True)]
    with open_udp(Address("::", port), "IPv6"):
        assert gist(ports(program, running=False), f"has udp port {port}") == [(Grade.PROBLEM, True)]


def test_the_interface_of_a_link_local_address_must_be_there(table: Path) -> None:
    program = rewritten(table, "http: {", 'foxglove: {address: "[fe80::1%nowhere0]:8765"}\nhttp: {')
    [found] = ports(program, running=False)
    assert found.text == "foxglove.address: no interface of this computer has fe80::1%nowhere0"
    assert found.remedy.endswith("or write [::] in the table")


@pytest.mark.parametrize(
    ("kind", "protocol", "gateway"),
    [
        (socket.SOCK_DGRAM, "udp", "{{transport: {{udp: 127.0.0.9:8502}}, receive: 127.0.0.1:{port}}}"),
        (socket.SOCK_STREAM, "tcp", "{{transport: {{tcp: 127.0.0.1:{port}}}}}"),
        (
            socket.SOCK_STREAM,
            "tcp",
            "{{transport: {{zenoh: {{key: k, listen: [tcp/127.0.0.1:{port}?so_sndbuf=65000]}}}}}}",
        ),
    ],
)
def test_a_port_of_a_gateway_that_somebody_has_is_told(
    tmp_path: Path, kind: socket.SocketKind, protocol: str, gateway: str
) -> None:
    port = free_port(kind=kind)
    path = tmp_path / "gateway.yaml"
    path.write_text(f"version: 1\ngateways: {{headset: {gateway.format(port=port)}}}\n")
    program = compiled(path)
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", port))
        if kind is socket.SOCK_STREAM:
            taken.listen()
        [found] = ports(program, running=False)
    assert found.grade is Grade.PROBLEM
    assert re.match(rf"gateway 'headset': .*\(pid {os.getpid()}\) has {protocol} port {port}$", found.text)
    assert gist(ports(program, running=False)) == [(Grade.FINE, True)]


def test_an_address_of_a_gateway_that_no_interface_has_is_told(tmp_path: Path) -> None:
    path = tmp_path / "gateway.yaml"
    gateway = "{transport: {udp: 127.0.0.9:8502}, receive: 192.0.2.1:8500}"
    path.write_text(f"version: 1\ngateways: {{headset: {gateway}}}\n")
    missing = "no interface of this computer has 192.0.2.1"
    assert gist(ports(compiled(path), running=False), missing) == [(Grade.WARNING, True)]


@pytest.mark.parametrize(
    ("variables", "networks", "warned"),
    [
        ({}, ["lo", "eth0", "wlan0"], "on eth0, wlan0"),
        ({"ROS_DOMAIN_ID": "0", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, ["lo", "eth0"], "on eth0"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, ["lo", "eth0"], None),
        ({"ROS_DOMAIN_ID": "42"}, ["lo", "eth0"], None),
        ({}, ["lo"], None),
    ],
)
def test_an_open_ros_domain_is_a_warning(
    table: Path, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], networks: list[str], warned: str | None
) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: list(enumerate(networks, 1)))
    monkeypatch.setattr(doctor_checks, "interface_is_up", lambda _: True)
    assert list(open_domain(compiled(table), variables)) == []  # without topics
    topic = "ph_info: {source: sensor_board, topics: [{topic: ph, type: comms/msg/SensorBoardPHInfo, fields: auto}]"
    program = rewritten(table, "ph_info: {source: sensor_board, destinations: [basestation]", topic)
    found = open_domain(program, variables)
    assert [(each.grade, each.text.partition("discovery ")[2]) for each in found] == (
        [(Grade.WARNING, warned)] if warned else []
    )


def on_interface(table: Path, name: str) -> CompiledTable:
    return rewritten(table, "receive_buffer:", f"interface: {name}, receive_buffer:")


def test_the_interface_of_a_listener_is_looked_at(table: Path) -> None:
    program = on_interface(table, "lo")
    assert texts(list(listeners(program)), Grade.FINE) == ["listener 'rover': network interface lo is up"]
    assert gist(ports(program, running=False)) == [(Grade.FINE, True)]


@pytest.mark.parametrize("look", [examine, before_start])
@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("receive_buffer:", "interface: nowhere0, receive_buffer:", "there is no such network interface"),
        ('address: "127.0.0.1:', 'address: "192.0.2.1:', "no network interface of this computer has that address"),
    ],
)
def test_what_a_listener_waits_for_is_a_warning(table: Path, look: type, old: str, new: str, why: str) -> None:
    """It may be a tunnel that comes up later, or a mistake."""
    [listener] = rewritten(table, old, new).listeners
    found = [finding for finding in look(table, {}) if finding.about in ("listeners", "ports")]
    assert [(each.grade, each.text) for each in found if each.about == "listeners"] == [
        (Grade.WARNING, f"listener 'rover' cannot use {listener.bound_to}: {why}")
    ]
    assert all(listener.bound_to not in each.text for each in found if each.about == "ports")


def test_an_interface_that_is_down_is_a_warning(table: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = on_interface(table, "lo")
    monkeypatch.setattr(doctor_checks, "interface_is_up", lambda _: False)
    [found] = listeners(program)
    assert (found.grade, found.remedy) == (Grade.WARNING, "run `ip link set lo up`")


def test_a_buffer_beyond_the_kernels_limit_is_a_warning(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rmem_max").write_text("65535\n")
    monkeypatch.setattr(doctor_checks, "RMEM_MAX", tmp_path / "rmem_max")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    [found] = receive_buffers(compiled(table))
    assert found.grade is Grade.WARNING
    assert "sysctl -w net.core.rmem_max=65536" in found.remedy
    (tmp_path / "rmem_max").unlink()  # as in a container on many kernels
    assert gist(receive_buffers(compiled(table)), "the kernel does not show here") == [(Grade.WARNING, True)]


def recorded(table: Path, folder: Path, keep: str, more: str = "") -> CompiledTable:
    table.write_text(f"{table.read_text()}record: {{directory: {folder}, retention: {keep}{more}}}\n")
    return compiled(table)


@pytest.mark.parametrize(
    ("folder", "keep", "grade", "text"),
    [
        ("later", "64MiB", Grade.FINE, "later, with 100 MiB free"),
        (".", "4GiB", Grade.WARNING, "room for 100 MiB, `retention` is 4096"),
        ("file/below", "4GiB", Grade.PROBLEM, "file is a file, not a folder"),
    ],
)
def test_recordings_need_a_folder_with_room(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, keep: str, grade: Grade, text: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1 << 30, 1 << 30, 100 << 20))
    assert gist(recordings(recorded(table, tmp_path / folder, keep), running=False), text) == [(grade, True)]


@pytest.mark.parametrize("target", ["recordings", "unmounted/recordings"])
def test_a_link_that_leads_nowhere_is_a_problem_as_it_is_for_a_start(table: Path, tmp_path: Path, target: str) -> None:
    link = tmp_path / "recordings"
    link.symlink_to(target)
    program = recorded(table, link, "1GiB")
    assert gist(recordings(program, running=False), f"{link} is a link that leads nowhere") == [(Grade.PROBLEM, True)]
    assert program.table.record is not None
    with pytest.raises(StartError, match="cannot record"):
        RecordingDirectory(program.table.record, "table")


def test_only_our_recordings_make_room_for_new_ones(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1 << 30, 1 << 30, 250 << 20))
    for name in ("table_000001_20260412T101500.000000Z.mcap", "somebody_elses.mcap"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(6 << 20)
    program = recorded(table, tmp_path, "260MiB")
    assert gist(recordings(program, running=False)) == [(Grade.WARNING, True)]
    (tmp_path / "table_000002_20260412T101500.000000Z_signal.mcap").write_bytes(bytes(4 << 20))
    assert gist(recordings(program, running=False)) == [(Grade.FINE, True)]


@pytest.mark.parametrize("running", [False, True])
def test_a_disk_that_is_almost_full_is_told(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, running: bool
) -> None:
    program = recorded(table, tmp_path, "1GiB", ", continuous: false, last: 60s")
    assert [each.grade for each in recordings(program, running=running)] == [Grade.FINE]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1 << 30, 1 << 30, 9 << 20))
    assert gist(recordings(program, running=running), "has 9 MiB free: the recording of a stop may not fit") == [
        (Grade.WARNING, True)
    ]


@pytest.mark.parametrize(("running", "grade"), [(False, Grade.WARNING), (True, Grade.PROBLEM)])
def test_a_disk_that_is_read_only_records_nothing_but_prevents_no_start(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, running: bool, grade: Grade
) -> None:
    program = recorded(table, tmp_path, "1GiB")
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY))
    assert gist(recordings(program, running=running), "is mounted read-only") == [(grade, True)]


def test_a_folder_that_takes_no_recordings_is_a_problem(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where what is below it cannot even be looked for."""
    private = tmp_path / "private"
    private.mkdir()
    program = recorded(table, private / "recordings", "4GiB")
    really = os.stat

    def stat(path: str | Path, **options: bool) -> os.stat_result:
        if str(path).startswith(f"{private}/"):
            raise PermissionError(13, "Permission denied", str(path))
        return really(path, **options)

    monkeypatch.setattr(os, "stat", stat)
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != private)
    assert gist(recordings(program, running=False), f"may not write to {private}") == [(Grade.PROBLEM, True)]
    assert gist(recordings(program, running=True), "the running router reports") == [(Grade.FINE, True)]


@pytest.mark.parametrize(
    ("now", "status", "grade"),
    [
        (datetime(1970, 1, 1, tzinfo=timezone.utc), 0, Grade.PROBLEM),
        (datetime(2026, 6, 1, tzinfo=timezone.utc), 0x40, Grade.WARNING),
        (datetime(2026, 6, 1, tzinfo=timezone.utc), 0x2001, Grade.FINE),
    ],
)
def test_the_clock(now: datetime, status: int, grade: Grade) -> None:
    assert [found.grade for found in clock(now, status)] == [grade]


def test_the_kernel_tells_of_the_clock() -> None:
    [found] = clock(datetime(2026, 6, 1, tzinfo=timezone.utc))
    assert "does not say" not in found.text


def test_nodes_of_two_users_that_share_memory_are_a_warning(tmp_path: Path) -> None:
    (tmp_path / "fastrtps_port7000").touch()
    assert list(shared_memory({}, tmp_path)) == []
    other = tmp_path / "fastrtps_port7411"
    other.touch()
    if os.geteuid() != 0:
        pytest.skip("only root can make a file of somebody else's")
    os.chown(other, 12345, 12345)
    [found] = shared_memory({}, tmp_path)
    assert (found.grade, "user 12345" in found.text) == (Grade.WARNING, True)


def test_a_node_that_exits_while_the_doctor_looks_is_not_a_crash(tmp_path: Path) -> None:
    (tmp_path / "fastrtps_port7000").symlink_to("gone")  # listed, but `stat` does not find it
    assert list(shared_memory({}, tmp_path)) == []


def test_an_endpoint_that_no_route_leads_to_is_a_problem_and_before_the_start_a_warning(
    table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_way(endpoint: Endpoint) -> tuple[str, str] | None:
        return ("no route leads there", "plug it in") if endpoint.name == "sensor_board" else None

    monkeypatch.setattr(doctor_checks, "why_no_way", no_way)
    text = "sensor_board: nothing can be sent to 127.0.0.30: no route leads there"
    [first, *others] = endpoints(compiled(table), {})
    assert first == (Grade.PROBLEM, "endpoints", text, "plug it in")
    assert "sensor_board" not in " ".join(finding.text for finding in others)
    assert list(before_start(table, {})) == [(Grade.WARNING, "endpoints", text, "plug it in")]


@pytest.mark.parametrize(
    ("found", "grade", "text"),
    [
        (["127.0.0.41"], Grade.FINE, "sensor_board: robot.local is 127.0.0.41"),
        (["224.0.0.1", "127.0.0.41"], Grade.FINE, "sensor_board: robot.local is 127.0.0.41"),
        (["224.0.0.1"], Grade.PROBLEM, "224.0.0.1 is not the address of a single machine"),
        (OSError(-2, "Name or service not known"), Grade.PROBLEM, "is not resolved: Name or service not known"),
        (None, Grade.PROBLEM, "the resolver does not answer within 5 s"),
    ],
)
def test_the_host_names_of_endpoints_are_resolved(
    table: Path, monkeypatch: pytest.MonkeyPatch, found: list[str] | OSError | None, grade: Grade, text: str
) -> None:
    never = threading.Event()

    def answer(host: str) -> list[str]:
        assert host == "robot.local"
        if found is None:
            never.wait(60)
        if isinstance(found, OSError):
            raise found
        return found or []

    monkeypatch.setattr(name_checks, "addresses_of", answer)
    names = Names(rewritten(table, "127.0.0.30:8", "robot.local:8"), patience=0.2 if found is None else 60)
    [result] = names.results()
    never.set()
    assert (result.grade, result.about) == (grade, "names")
    assert text in result.text
    if grade is Grade.PROBLEM:
        assert list(endpoints(names.program, {}))
        assert "sensor_board" not in " ".join(each.text for each in endpoints(names.program, {}))


def test_a_broadcast_address_is_a_problem(table: Path) -> None:
    rewritten(table, "127.0.0.30:8", "127.255.255.255:8")
    [found] = before_start(table, {})
    text = "sensor_board: 127.255.255.255 is not the address of a single machine"
    hint = "write the address of one machine; for several, an endpoint has `group` or `broadcast` instead"
    assert found == (Grade.PROBLEM, "endpoints", text, hint)


def test_who_answers_a_ping() -> None:
    try:
        assert doctor_checks.answering({"127.0.0.30", "::1", "127.0.0.40"}) == {"127.0.0.30", "::1", "127.0.0.40"}
        assert doctor_checks.answering({"::1"}) == {"::1"}
        assert doctor_checks.answering({"127.0.0.30", "fe80::1%nowhere0"}, 0.05) == {"127.0.0.30"}
    except PermissionError:
        pytest.skip("this user may not ping")


# -- a running router ----------------------------------------------------------------------------------------------


@contextmanager
def serving(program: CompiledTable, *problems: Problem, **learned: str) -> Iterator[None]:
    """A router that runs the program's table, in which this is wrong, and which has learned these addresses."""
    table = program.table
    assert table.http is not None
    with answering("", table.http.address.value, problems=problems, learned=learned, table=table.sha256):
        yield


def told(table: Path) -> list[CheckResult]:
    """Of the running router."""
    return [found for found in examine(table, {}) if found.about == "router"]


@pytest.mark.parametrize("text", ["<html>hello</html>", "", "{}", "[]", '{"table": 1, "problems": 7}'])
def test_another_program_at_the_routers_address_has_its_port(table: Path, text: str) -> None:
    http = compiled(table).table.http
    assert http is not None
    with answering("", http.address.value, health=text):
        [taken] = texts(list(examine(table, {})), Grade.PROBLEM)
    assert f"(pid {os.getpid()}) has tcp port" in taken


def test_a_healthy_router_is_fine(table: Path) -> None:
    with serving(compiled(table)):
        assert gist(told(table), "7 datagrams received") == [(Grade.FINE, True)]


def test_the_addresses_that_a_running_router_has_learned_are_told(table: Path) -> None:
    program = rewritten(table, '"127.0.0.30:8"', "learned, because: a test")
    with serving(program, sensor_board="127.0.0.41:9000"):
        found = [each for each in examine(table, {}) if each.text.startswith("sensor_board")]
    assert [each[:3] for each in found] == [(Grade.FINE, "endpoints", "sensor_board: learned at 127.0.0.41:9000")]
    with serving(program):
        [missing] = [each for each in examine(table, {}) if each.text.startswith("sensor_board")]
    assert missing.grade is Grade.WARNING
    assert not [each for each in examine(table, {}) if each.text.startswith("sensor_board")]


def test_what_is_wrong_with_a_running_router_is_told_with_its_remedy_and_page(table: Path) -> None:
    stuck = Problem(Kind.RECEIVE_STUCK, {}, ": no progress for 7 s", "Restart it.")
    silent = Problem(Kind.ENDPOINT_SILENT, {"endpoint": "sensor_board"}, ": last heard 9 s ago", "Check its cable.")
    with serving(compiled(table), stuck, silent):
        first, second = told(table)
    page_path = page("docs/troubleshooting/alerts.md")
    assert first == problem(
        "router", "the receive thread is stuck: no progress for 7 s", f"Restart it. See {page_path}#receivestuck"
    )
    assert second == warning(
        "router", "sensor_board is silent: last heard 9 s ago", f"Check its cable. See {page_path}#endpointsilent"
    )


def test_pages_are_those_of_this_installation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for kind in Kind:
        path, _, section = page(Problem(kind, dict.fromkeys(kind.labels, "x")).page).partition("#")
        assert f"## {section}\n" in Path(path).read_text(encoding="utf-8").lower()


def test_a_rover_that_nobody_drives_is_fine(table: Path) -> None:
    with serving(compiled(table), Problem(Kind.HALTED, {"route": "drive"}, " for 27 min")):
        first, second = told(table)
    assert first == fine("router", "drive is halted: no commands for 27 min")
    assert second.grade is Grade.FINE


def test_who_sends_in_place_of_an_endpoint_that_answers_no_ping_is_named(
    table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor_checks, "answering", lambda hosts: hosts - {"127.0.0.30"})
    labels = {"endpoint": "sensor_board", "sender": "127.0.0.20"}
    with serving(compiled(table), Problem(Kind.ENDPOINT_NEVER_HEARD, labels)):
        found = [each.text for each in examine(table, {}) if each.about == "endpoints" and each.grade is Grade.WARNING]
    assert found == ["sensor_board: 127.0.0.30 does not answer a ping, but 127.0.0.20 sends its payloads"]


def test_a_router_that_runs_another_table_is_told(table: Path) -> None:
    with serving(compiled(table)):
        rewritten(table, "version: 1", "version: 1  # changed")
        assert texts(told(table), Grade.WARNING) == ["its table differs from this file"]


def test_the_ports_of_a_running_router_are_not_a_problem(table: Path) -> None:
    with serving(compiled(table)):
        found = list(examine(table, {}))
    assert texts(found, Grade.PROBLEM) == []
    assert "the running router has them" in texts(found, Grade.FINE)
