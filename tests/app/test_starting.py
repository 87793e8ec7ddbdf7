"""`router run` as a process: exit codes, signals, ROS arguments, what it writes, and what may be wrong around it."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import dropwhile
from pathlib import Path
from typing import Any

import pytest

from router.carrier.build import compile_c
from router.errors import ConfigurationError, StartError
from router.ros.environment import SHM, obstacles, unresolved_peers, uses_shared_memory
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.repeating import repeating
from tests.routers import MODULE, log_until_started, start
from tests.tables import PROTOS, ROUTES

ROOT = Path(__file__).parents[2]
TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: "127.0.0.1:${{LISTEN_PORT}}"}}
record: {{last: 10s, directory: {folder}}}
endpoints:
  basestation: {{address: "127.0.0.1:{destination}", kind: basestation}}
routes:
  ph_info:
    source: any
    destinations: [basestation]
"""
TOPIC = "    topics: [{topic: ph, type: comms/msg/SensorBoardPHInfo, fields: auto}]\n"

HALTING = """\
import sys


class Halting:
    '''Says that `router.cli` is about to be imported, and waits for a line.'''

    def find_spec(self, name, path=None, target=None):
        if name == "router.cli":
            print("importing", flush=True)
            sys.stdin.readline()


sys.meta_path.insert(0, Halting())
"""

SCRIPT = ["-c", "import sys; from router import main; sys.exit(main())"]
"""What the console script does."""


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LISTEN_PORT", str(free_port()))
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(protos=PROTOS, folder=tmp_path / "recordings", destination=free_port()))
    return path


def wait_for_start(process: subprocess.Popen[str]) -> dict[str, object]:
    assert process.stderr
    return dict(json.loads(log_until_started(process.stderr)[-1]))


def end(process: subprocess.Popen[str], number: int = signal.SIGTERM) -> list[str]:
    """The events that are logged until it has ended, as it should."""
    process.send_signal(number)
    _, log = process.communicate(timeout=20)
    assert process.returncode == 0
    return [json.loads(line)["event"] for line in log.splitlines()]


def halted(how: Sequence[str], tmp_path: Path, *arguments: str | Path, **options: Any) -> subprocess.Popen[str]:
    """Before it imports anything that takes long. It goes on after a line."""
    folder = tmp_path / "halting"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(HALTING)
    process = start(how, *arguments, path=str(folder), **options)
    assert process.stdout
    assert process.stdout.readline() == "importing\n"
    return process


def ended(*arguments: str | Path, **options: object) -> tuple[int, list[str]]:
    """Exit code and what it said, without warnings about the table."""
    process = start(MODULE, *arguments, **options)  # type: ignore[arg-type]
    try:
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, list(dropwhile(lambda line: not line.startswith("router "), said.splitlines()))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_gracefully(table: Path, number: signal.Signals) -> None:
    process = start(MODULE, "run", table)
    wait_for_start(process)
    assert end(process, number) == ["router stopping", "router stopped"]


@pytest.mark.parametrize("how", [MODULE, SCRIPT])
def test_its_process_ends_without_what_libraries_do_at_the_end(table: Path, tmp_path: Path, how: Sequence[str]) -> None:
    library = tmp_path / "library"
    library.mkdir()
    (library / "sitecustomize.py").write_text("import atexit, time\natexit.register(time.sleep, 60)\n")
    process = start(how, "run", table, path=str(library))
    wait_for_start(process)
    assert end(process) == ["router stopping", "router stopped"]


def test_a_ros_parameter_is_a_table_variable_and_wins_over_the_environment(table: Path) -> None:
    port = free_port()
    process = start(MODULE, "run", table, "--ros-args", "-p", f"listen_port:={port}")
    assert wait_for_start(process)["listening"] == {"rover": f"127.0.0.1:{port}"}
    end(process)


def test_a_misspelt_ros_parameter_is_named_at_the_start(table: Path) -> None:
    process = start(MODULE, "run", table, "--ros-args", "-p", "listen_prot:=9")
    assert process.stderr
    said = json.loads(next(line for line in process.stderr if "listen_prot" in line))
    assert (said["level"], said["argument"]) == ("warning", "-p listen_prot")
    assert said["remedy"] == "did you mean 'listen_port'?"
    wait_for_start(process)
    end(process)


DEADMAN = "    deadman: {timeout: 500ms, send: {ph_info: {}}, to: [basestation]}\n"


def test_the_log_says_where_to_look(table: Path) -> None:
    pages = {name: f"127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}" for name in ("http", "foxglove")}
    table.write_text(table.read_text() + "".join(f"{name}: {{address: {place}}}\n" for name, place in pages.items()))
    process = start(MODULE, "run", table)
    wait_for_start(process)
    assert process.stderr
    places = json.loads(process.stderr.readline())
    assert places["event"] == "where to look"
    assert places["status page"] == f"http://{pages['http']}/"
    assert places["Foxglove"] == f"ws://{pages['foxglove']}"
    end(process)


def test_the_metrics_say_how_it_started(table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    address = f"127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
    table.write_text(f'http: {{address: "{address}"}}\n{table.read_text()}')
    folder = tmp_path / "halting"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(HALTING)

    def started(*arguments: str, edit: str = "") -> str:
        """How a start ends whose table is edited when its head start, if it has one, has begun."""
        process = start(MODULE, "run", table, *arguments, path=str(folder))
        assert process.stdin
        assert process.stdout
        assert process.stdout.readline() == "importing\n"
        table.write_text(table.read_text() + edit)
        process.stdin.write("\n")
        process.stdin.flush()
        wait_for_start(process)
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=10) as answer:
            [how] = re.findall(r'^router_build_info{.*start="(\w+)"', answer.read().decode(), re.MULTILINE)
        wait_until(lambda: "--no-cache" in arguments or how_explained() == "  a start uses it", "a kept program")
        end(process)
        return str(how)

    def how_explained() -> str:
        environment = {**os.environ, "PYTHONPATH": f"{folder}:{ROOT}"}
        command = [sys.executable, *MODULE, "explain", "-t", str(table)]
        said = subprocess.check_output(command, env=environment, stdin=subprocess.DEVNULL, text=True)
        return said.splitlines()[-1]

    assert started("--no-cache") == "compiled"
    assert started() == "compiled"
    assert started() == "kept"
    assert started(edit="# a comment\n") == "kept"
    assert started(edit="  gps_info: {source: any, destinations: [basestation]}\n") == "replaced"
    table.write_text(f"{table.read_text()}# another one\n")
    assert started() == "refused"
    assert started() == "kept"


def test_arguments_that_ros_refuses_end_it_before_deadmen_send(table: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    text = table.read_text() + DEADMAN + TOPIC
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(0.5)
        port = station.getsockname()[1]
        table.write_text(re.sub(r"(basestation: {address: \"127.0.0.1:)\d+", rf"\g<1>{port}", text))
        code, said = ended("run", table, "--ros-args", "--bad")
        assert (code, said) == (78, ["router run: ROS rejects these arguments: ['--bad']"])
        with pytest.raises(TimeoutError):
            station.recv(100)


def test_without_its_library_it_says_so_and_ends(table: Path, tmp_path: Path) -> None:
    """With no thread left that keeps the process alive, while signals are blocked."""
    nowhere = tmp_path / "libcarrier.so"
    (tmp_path / "sitecustomize.py").write_text(
        f"from pathlib import Path; from router.library import load; load.__defaults__ = (Path({str(nowhere)!r}),)"
    )
    said = [f"router run: {nowhere} was not built, and nothing runs without it", "help: run 'make setup'"]
    assert ended("run", table, path=str(tmp_path)) == (78, said)


def test_a_machine_without_ros_is_told_what_to_do(table: Path, tmp_path: Path) -> None:
    without = tmp_path / "without_ros"
    without.mkdir()
    (without / "rclpy.py").write_text("raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')\n")
    table.write_text(table.read_text() + TOPIC)
    code, said = ended("run", table, path=str(without))
    assert code == 78
    assert "\n".join(said) == (
        f"router run: {table} has topics or services, and ROS 2 cannot be loaded: No module named 'rclpy'\nhelp: "
        "run 'make setup', or source the setup.sh of an installed ROS 2 Jazzy"
    )


@pytest.mark.parametrize(("verb", "expected"), [("run", 78), ("listen", 2)])
def test_a_type_support_that_cannot_be_loaded_is_told(table: Path, tmp_path: Path, verb: str, expected: int) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    package = find_spec("comms")
    assert package is not None
    assert package.origin is not None
    broken = shutil.copytree(Path(package.origin).parent, tmp_path / "broken" / "comms")
    library = broken / "comms_s__rosidl_typesupport_c.so"
    library.write_text("what is this")
    table.write_text(table.read_text() + TOPIC)
    what = [table] if verb == "run" else ["topic:///ph", "--type", "comms/msg/SensorBoardPHInfo"]
    code, said = ended(verb, *what, path=str(broken.parent))
    assert code == expected
    where = f"{table}:12:22: " if verb == "run" else ""
    why = f"Could not import 'rosidl_typesupport_c' for package 'comms': {library}: file too short"
    assert said == [
        f"router {verb}: {where}comms/msg/SensorBoardPHInfo cannot be used: {why}",
        "help: run 'make setup' and `. .venv/env.sh`, or install the ROS package 'comms'",
    ]


def test_a_table_with_errors_is_told_and_ends_with_78(table: Path) -> None:
    table.write_text(table.read_text().replace("destinations: [basestation]", "destinations: [nobody]"))
    process = start(MODULE, "run", table)
    _, text = process.communicate(timeout=20)
    assert process.returncode == 78
    assert f"{table}:11:20: error[unknown-endpoint]" in text


def test_a_port_in_use_is_told_and_a_later_start_may_succeed(table: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setenv("LISTEN_PORT", str(taken.getsockname()[1]))
        code, [said, remedy] = ended("run", table)
    assert (code, remedy) == (1, "help: stop it, or choose another port")
    assert said.startswith(f"router run: {table}:4:20: listener 'rover' cannot use")
    assert f"(pid {os.getpid()}) has the port" in said


def test_sighup_and_the_command_have_the_table_read_again(table: Path) -> None:
    metrics = free_port(kind=socket.SOCK_STREAM)
    table.write_text(f'http: {{address: "127.0.0.1:{metrics}"}}\n' + table.read_text())
    process = start(MODULE, "run", table)
    wait_for_start(process)
    good = table.read_text()
    asking = [sys.executable, "-m", "router", "reload", "-t", str(table)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    table.write_text(good + "  gps_info: {source: any, destinations: [basestation]}\n")
    answer = subprocess.run(asking, env=environment, capture_output=True, text=True, check=False)
    assert (answer.returncode, answer.stdout) == (0, "route gps_info added\n")

    table.write_text(good + "  gps_infos: {source: any, destinations: [basestation]}\n")
    answer = subprocess.run(asking, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 78
    assert "unknown-payload-case" in answer.stderr
    assert "rejected; the old table is still running: the table has 1 error" in answer.stderr

    table.write_text(good)
    process.send_signal(signal.SIGHUP)
    assert process.stderr
    told = next(entry for entry in map(json.loads, process.stderr) if entry.get("result") == "route gps_info removed")
    assert told["event"] == "table reloaded"
    end(process)


def test_it_stops_however_many_reloads_are_asked_for(table: Path) -> None:
    process = start(MODULE, "run", table)
    wait_for_start(process)
    try:
        with repeating(partial(process.send_signal, signal.SIGHUP), 0.001):
            assert process.stderr
            assert any('"table reloaded"' in line for line in process.stderr)
            end(process)
    finally:
        process.kill()


@pytest.mark.parametrize("how", [MODULE, SCRIPT], ids=["module", "script"])
def test_signals_that_come_before_it_routes_are_served_when_it_does(
    table: Path, tmp_path: Path, how: Sequence[str]
) -> None:
    process = halted(how, tmp_path, "run", table)
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGUSR1)
    assert process.stdin
    assert process.stderr
    process.stdin.close()
    wanted = {"router started", "table reloaded", "saved the last datagrams"}
    for line in process.stderr:
        if line.startswith("{"):
            wanted.discard(json.loads(line)["event"])
        if not wanted:
            break
    process.stdin = None
    process.terminate()
    process.communicate(timeout=20)
    assert (process.returncode, wanted) == (0, set())


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1])
def test_other_verbs_end_by_them(table: Path, tmp_path: Path, number: signal.Signals) -> None:
    def heed() -> None:
        signal.signal(number, signal.SIG_DFL)  # nohup has what it runs ignore SIGHUP

    process = halted(MODULE, tmp_path, "validate", table, preexec_fn=heed)
    process.send_signal(number)
    process.communicate(timeout=20)
    assert process.returncode == -number


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, -signal.SIGTERM), (signal.SIGINT, 130)])
def test_a_signal_that_ends_it_needs_no_router_that_routes(
    table: Path, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    process = halted(MODULE, tmp_path, "run", table)
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    assert (process.returncode, said) == (code, "")


def test_a_working_directory_that_was_deleted_is_told(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()

    def delete() -> None:
        gone.rmdir()

    said = ["router run: the working directory was deleted", "help: change to one that exists"]
    assert ended("run", "table.yaml", cwd=gone, preexec_fn=delete) == (78, said)


def may_map(mebibytes: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_AS, (mebibytes << 20, mebibytes << 20))


@pytest.mark.parametrize("mebibytes", [40, 60, 80])
def test_too_little_address_space_is_told(table: Path, mebibytes: int) -> None:
    """It ends in the imports, while the table is compiled, or with the first thread."""
    code, said = ended("run", table, preexec_fn=may_map(mebibytes))
    assert code == 1
    assert len(said) == 1
    assert said[0].startswith(f"router run: this process may map {mebibytes} MiB of memory (ulimit -v), which is not")


def test_too_little_address_space_for_ros_is_told_before_ros_is_loaded(table: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    table.write_text(table.read_text() + TOPIC)
    code, said = ended("run", table, preexec_fn=may_map(300))
    assert code == 1
    assert said[0].startswith("router run: this process may map 300 MiB of memory (ulimit -v), but ROS 2 needs 1024")


SHORT_OF_FILES = (4, 6, 9, 12, 16, 18, 19)
"""Descriptors, of which a start needs 20: Python's own files, the protos, the carrier's events, sockets, threads."""


@pytest.mark.parametrize("descriptors", SHORT_OF_FILES)
def test_a_lack_of_descriptors_may_pass(table: Path, descriptors: int) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))

    assert ended("run", table, "--no-cache", preexec_fn=limit)[0] == 1


@pytest.mark.parametrize("descriptors", [16, 20, 24, 28])
def test_a_lack_of_descriptors_for_ros_may_pass(table: Path, descriptors: int) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))

    table.write_text(table.read_text() + TOPIC)
    assert ended("run", table, "--no-cache", preexec_fn=limit)[0] == 1


@pytest.fixture(scope="session")
def failing_thread(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library to preload that makes the start of one thread fail."""
    made = tmp_path_factory.mktemp("failing") / "thread.so"
    compile_c(["-shared", "-fPIC", str(Path(__file__).with_name("failing_thread.c")), "-ldl", "-o", str(made)])
    return made


@pytest.mark.parametrize("thread", range(1, 8))
def test_a_lack_of_threads_may_pass(
    table: Path, thread: int, failing_thread: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LD_PRELOAD", str(failing_thread))
    monkeypatch.setenv("FAILING_THREAD", str(thread))
    code, said = ended("run", table, "--no-cache")
    assert code == 1
    assert re.search("can't start new thread|threads cannot be started: Resource temporarily unavailable", said[-1])


def test_a_peer_that_does_not_resolve_may_be_known_later(table: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    table.write_text(table.read_text() + TOPIC)
    monkeypatch.setenv("ROS_STATIC_PEERS", "127.0.0.1;base.invalid")
    code, [said, remedy] = ended("run", table)
    assert code == 1
    assert said.startswith("router run: ROS_STATIC_PEERS names 'base.invalid', which does not resolve: ")
    assert remedy == "help: correct it, or see that the name server or /etc/hosts knows it"
    checked = start(MODULE, "doctor", "--pre-start", "-t", table)
    told, _ = checked.communicate(timeout=60)
    assert checked.returncode == 1
    assert "problem  ROS        ROS_STATIC_PEERS names 'base.invalid', which does not resolve" in told

    monkeypatch.setenv("ROS_STATIC_PEERS", "192.168.0.400")
    assert ended("run", table)[0] == 78


def test_peers_are_resolved_where_ros_does(monkeypatch: pytest.MonkeyPatch) -> None:
    peers = {"ROS_STATIC_PEERS": ";127.0.0.1;;x.invalid;x y;"}
    assert [type(each) for each in unresolved_peers(peers)] == [StartError, ConfigurationError]
    for ignoring in (
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
        {"ROS_LOCALHOST_ONLY": "1"},
        {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
    ):
        assert list(unresolved_peers(peers | ignoring)) == []


def test_an_environment_that_ros_does_not_take_is_told(table: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    table.write_text(table.read_text() + TOPIC)
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    told = ["router run: ROS_DOMAIN_ID is '233'", "help: set it to a number from 0 to 232"]
    assert ended("run", table) == (78, told)


@pytest.mark.parametrize("name", ["run", "doctor"])
def test_a_full_shared_memory_is_told(table: Path, name: str) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("only root can have a /dev/shm of its own, by unshare")
    table.write_text(table.read_text() + TOPIC)
    full = f"mount -t tmpfs -o size=64k tmpfs {SHM} && head -c 64k /dev/zero > {SHM}/full"
    within = ["unshare", "-m", "sh", "-c", f'{full} && exec "$@"', "sh"]
    process = start(MODULE, name, "-t", table, within=within)
    told = process.communicate(timeout=60)
    assert process.returncode == 1
    assert f"{SHM} has 0 KiB free, but ROS 2 needs" in "".join(told)


def test_what_a_domain_may_be_and_which_transports_share_memory(tmp_path: Path) -> None:
    for domain in ("", "0", "7", "232"):
        assert list(obstacles({"ROS_DOMAIN_ID": domain})) == []
    for domain in ("233", "-5", "1e2", "4294967296", " 5", "five"):
        [wrong] = obstacles({"ROS_DOMAIN_ID": domain})
        assert wrong.what == f"ROS_DOMAIN_ID is '{domain}'"
    [wrong] = obstacles({"RMW_IMPLEMENTATION": "rmw_dust"})
    assert wrong.what == "RMW_IMPLEMENTATION is 'rmw_dust', which is not installed here"
    transports = "FASTDDS_BUILTIN_TRANSPORTS"
    assert all(uses_shared_memory({transports: each}) for each in ("", "DEFAULT", "SHM", "LARGE_DATA?max_msg_size=1MB"))
    assert not any(uses_shared_memory({transports: each}) for each in ("UDPv4", "UDPv6", "TCPv4", "NONE"))
    assert not uses_shared_memory({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"})
    assert list(obstacles({}, tmp_path / "none")) == []


def test_an_endpoint_that_the_rovers_table_gets_is_an_error_in_that_for_one_machine(tmp_path: Path) -> None:
    """Its real address was inherited there, and datagrams left the machine."""
    shutil.copytree(ROUTES, tmp_path / "routes")
    rover, sim = tmp_path / "routes" / "rover.yaml", tmp_path / "routes" / "sim.yaml"
    text = rover.read_text(encoding="utf-8").replace("protos: ../protos", f"protos: {PROTOS}")
    rover.write_text(text.replace("\nendpoints:\n", "\nendpoints:\n  camera: {address: 192.168.0.60:8, kind: tool}\n"))
    line = rover.read_text().splitlines().index("  camera: {address: 192.168.0.60:8, kind: tool}") + 1
    found = f"{rover}:{line}:21: error[outside-networks]: 'address' of endpoints.camera is 192.168.0.60:8, outside"
    for verb in (f"validate {sim}", f"run {sim}", f"send ph_info --table {sim} --to camera"):
        process = start(MODULE, *verb.split())
        try:
            told = "".join(process.communicate(timeout=60))
        finally:
            process.kill()
        assert found in told, verb
        assert process.returncode == 78, verb
    sim.write_text(sim.read_text().replace("\nendpoints:\n", "\nendpoints:\n  camera: {address: 127.0.0.60:25008}\n"))
    assert ended("validate", sim)[0] == 0
