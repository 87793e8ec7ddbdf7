"""The units under a real systemd, in a small machine of their own: hardened, watched, restarted, and left alone."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from router.compiler import check_table
from tests.deploy.machine import Machine, hidden_by, machine
from tests.tables import ROUTES

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
UNITS = ROOT / "deploy" / "systemd"
NAMES = ("rover-router.service", "rover-router.socket", "rover-router-hold.service", "rover-gateways.service")
MOST_EXPOSED = 2.0
ENVIRONMENT = f". {ROOT}/.venv/env.sh"
ROUTER = f"{ROOT}/.venv/bin/router"
SIM = f"{ROUTES}/sim.yaml"
METRICS = "curl -s 127.0.0.1:29108/metrics"
SEND = f"{ROUTER} send ph_info ph_value=7 --table {SIM} --to rover --from sensor_board"
BAD_TABLE = 78


def analyze(*arguments: object, units: Path = UNITS) -> str:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    command = ["systemd-analyze", *map(str, arguments)]
    paths = {**os.environ, "SYSTEMD_UNIT_PATH": f"{units}:"}
    finished = subprocess.run(command, env=paths, capture_output=True, text=True, check=False, cwd=units)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout + finished.stderr


def exposure(name: str, units: Path) -> float:
    out = analyze("security", "--offline=true", "--no-pager", name, units=units)
    exposed = re.search(rf"Overall exposure level for {name}: ([\d.]+)", out)
    assert exposed is not None, out
    return float(exposed[1])


@pytest.fixture
def with_lines(tmp_path: Path) -> Path:
    """The units as they are for a table with serial lines."""
    for name in NAMES:
        shutil.copy(UNITS / name, tmp_path)
    (tmp_path / "rover-router.service.d").mkdir()
    shutil.copy(UNITS / "serial-lines.conf", tmp_path / "rover-router.service.d")
    return tmp_path


@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith(".service")])
def test_a_service_may_do_little(name: str) -> None:
    assert exposure(name, UNITS) <= MOST_EXPOSED


def test_with_serial_lines_it_may_do_little_more(with_lines: Path) -> None:
    assert exposure("rover-router.service", UNITS) < exposure("rover-router.service", with_lines) <= MOST_EXPOSED


def test_the_units_are_as_systemd_wants_them(with_lines: Path) -> None:
    assert analyze("verify", *(f"./{name}" for name in NAMES)) == ""
    assert analyze("verify", "./rover-router.service", units=with_lines) == ""


def test_the_socket_has_the_addresses_of_the_rovers_table() -> None:
    program = check_table(ROUTES / "rover.yaml", {}).program
    assert program is not None
    text = (UNITS / "rover-router.socket").read_text()
    assert re.findall("^ListenDatagram=(.*)$", text, re.MULTILINE) == [
        str(each.address.value) for each in program.listeners
    ]


@pytest.mark.parametrize("name", ["our rover", "r&d", "a|b", "100%", "it's", "a$b", "a#b"])
def test_a_place_that_units_or_settings_would_garble_is_refused(tmp_path: Path, name: str) -> None:
    script = tmp_path / name / "deploy" / "install-service.sh"
    script.parent.mkdir(parents=True)
    shutil.copy(ROOT / "deploy" / "install-service.sh", script)
    finished = subprocess.run([script], capture_output=True, text=True, check=False)
    assert finished.returncode == 1
    assert finished.stderr == (
        f"install-service: '{tmp_path / name}' has characters that systemd or a shell would misread: move it\n"
    )


@pytest.fixture
def refusing(tmp_path: Path) -> Path:
    """A checkout in which install-service.sh comes as far as its table, which has errors, and changes nothing."""
    if os.geteuid() != 0 or shutil.which("systemctl") is None:
        pytest.skip("needs root and systemctl")
    for folder in ("deploy", ".venv/bin", "routes"):
        (tmp_path / folder).mkdir(parents=True)
    shutil.copy(ROOT / "deploy" / "install-service.sh", tmp_path / "deploy")
    for program in ("router", "python"):
        path = tmp_path / ".venv" / "bin" / program
        path.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
        path.chmod(0o755)
    (tmp_path / ".venv" / "env.sh").touch()
    (tmp_path / "routes" / "rover.yaml").write_text("version: 7\n")
    return tmp_path


def refused(checkout: Path) -> subprocess.CompletedProcess[str]:
    command = [checkout / "deploy" / "install-service.sh", checkout / "routes" / "rover.yaml"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert finished.returncode == 1
    return finished


def refusal(checkout: Path) -> str:
    return refused(checkout).stderr


def test_it_says_what_runs_as_root_and_who_can_change_that(refusing: Path) -> None:
    os.chown(refusing, 65534, -1)
    assert refused(refusing).stdout == (
        f"install-service: runs code of {refusing} as root, which 'nobody' can change: .venv/env.sh, .venv/bin/python "
        "and router/; it also runs /etc/default/rover-router; the service runs as 'rover-router'\n"
    )


def test_an_environment_that_reads_unset_variables_is_sourced(refusing: Path) -> None:
    """As ROS's setup.sh does."""
    (refusing / ".venv" / "env.sh").write_text('[ -z "$NOBODY_SET_IT" ] && echo sourced >&2\n')
    said = refusal(refusing).splitlines()
    assert said[0] == "sourced"
    assert "error[missing-key]" in said[1]
    assert said[-1] == "install-service: nothing was changed: the table has errors"


def test_an_environment_that_is_broken_is_no_error_of_the_table(refusing: Path) -> None:
    (refusing / ".venv" / "env.sh").write_text("exit 1\n")
    assert refusal(refusing) == "install-service: nothing was changed: the table could not be checked\n"


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A computer on which `make install-service` was done, for the simulated rover's table."""
    if not Path(ROUTER).exists():
        pytest.skip("needs .venv")
    for tool in ("curl", "setpriv", "ss"):
        if shutil.which(tool) is None:
            pytest.skip(f"needs {tool}")
    if hidden := hidden_by(ROOT):
        pytest.skip(f"the machine has a {hidden} of its own, without this checkout")
    with machine(tmp_path_factory.mktemp("machine")) as found:
        found.shell(f"{ROOT}/deploy/install-service.sh {SIM}")
        yield found


@pytest.fixture
def running(rover: Machine) -> Machine:
    rover.shell("systemctl reset-failed; systemctl start rover-router")
    return rover


def test_the_machine_leaves_formats_of_programs_to_this_computer(rover: Machine) -> None:
    """The kernel has one list for all: systemd would drop emulators that somebody has registered."""
    assert rover.state("systemd-binfmt") == "inactive"


def test_installing_starts_it_at_once_and_at_boot(running: Machine) -> None:
    assert running.state() == running.state("rover-router.socket") == "active"
    assert running.show("UnitFileState") == "enabled"
    assert running.show("User") == "rover-router"


def test_it_runs_on_the_carrier(running: Machine) -> None:
    pid = running.show("MainPID")
    assert f"{ROOT}/router/carrier/native/libcarrier.so" in running.shell(f"cat /proc/{pid}/maps")


def test_what_receives_and_brakes_runs_at_a_real_time_priority(running: Machine) -> None:
    if running.run("prlimit", "--rtprio=1", "true", check=False).returncode:
        pytest.skip("systemd may not raise limits here; tests/platforms/systemd.sh boots one that may")
    threads = running.shell("ps -L -o cls=,rtprio=,comm= -p $(systemctl show -P MainPID rover-router)").splitlines()
    first = {tuple(line.split(maxsplit=2)) for line in threads if line.split()[0] == "FF"}
    assert first == {("FF", "1", name) for name in ("receive", "timers", "ros urgent")}


def test_nothing_else_waits_for_its_sockets_at_boot(running: Machine) -> None:
    """Or what makes the interface of a listener, such as a tunnel, would wait until systemd no longer does."""
    for relation in ("Before", "WantedBy", "RequiredBy"):
        assert set(running.show(relation, "rover-router.socket").split()) <= {
            "rover-router.service", "rover-router-hold.service", "shutdown.target",
        }  # fmt: skip


def test_an_interface_that_is_not_there_is_not_waited_for_and_taken_when_it_comes(running: Machine) -> None:
    if running.state("systemd-udevd") != "active":
        pytest.skip("systemd waits for an interface only with udev; tests/platforms/systemd.sh boots both")
    table = f"""version: 1
extends: {SIM}
listen: {{radio: {{address: 127.0.0.6:25000, interface: late0}}}}
"""
    running.shell(f"printf '%s' '{table}' > /opt/late.yaml; {ROOT}/deploy/install-service.sh /opt/late.yaml")
    assert running.state() == "active"
    running.shell("ip link add late0 type dummy; ip link set late0 up")
    running.wait_for("ss -lunpH | grep 127.0.0.6%late0:25000 | grep -q python")
    running.shell("systemctl restart rover-router")
    assert '"systemd"' in running.shell("ss -lunpH | grep 127.0.0.6%late0:25000")
    running.shell(f"{ROOT}/deploy/install-service.sh {SIM}; ip link del late0; ls /etc/systemd/system")
    assert running.shell("ls /etc/systemd/system/*.device.d").strip() == ""


def test_installing_again_changes_nothing_and_restarts_it(running: Machine) -> None:
    before, sockets = running.show("MainPID"), running.show("ActiveEnterTimestamp", "rover-router.socket")
    running.shell(f"{ROOT}/deploy/install-service.sh")
    assert running.show("MainPID") != before
    assert running.show("ActiveEnterTimestamp", "rover-router.socket") == sockets


def test_a_table_is_chosen_also_where_the_settings_name_none(running: Machine) -> None:
    settings = "/etc/default/rover-router"
    running.shell(f"cp {settings} /opt/settings; sed -i 's/^ROUTER_TABLE=/#&/' {settings}; printf 'A=b' >> {settings}")
    running.shell(f"{ROOT}/deploy/install-service.sh {SIM}")
    assert running.shell(f"grep ^ROUTER_TABLE= {settings}").strip() == f"ROUTER_TABLE={SIM}"
    assert "A=b\n" in running.shell(f"cat {settings}")
    assert f"ROUTER_TABLE={SIM}" in running.environment()
    running.shell(f"cp /opt/settings {settings}; systemctl restart rover-router")


def test_a_table_with_errors_is_not_installed(running: Machine) -> None:
    running.shell("echo 'version: 7' > /opt/bad.yaml; cp /etc/default/rover-router /opt/settings")
    finished = running.run(f"{ROOT}/deploy/install-service.sh", "/opt/bad.yaml", check=False)
    assert finished.returncode == 1
    assert "bad.yaml:1:1: error[missing-key]" in finished.stderr
    running.shell("cmp /etc/default/rover-router /opt/settings")
    assert running.state() == "active"


@pytest.fixture
def apart(running: Machine) -> Iterator[Machine]:
    """The machine with the gateways of the table in a service of their own."""
    alone = f"version: 1\nextends: {SIM}\ngateways: {{dashboard: {{ignore: gateways.yaml has it}}}}\n"
    gateways = """version: 1
node: {name: rover_gateways}
http: {address: 127.0.0.1:29109}
gateways: {dashboard: {transport: {websocket: 127.0.0.1:28765}}}
"""
    running.shell(f"printf '%s' '{alone}' > /opt/alone.yaml; printf '%s' '{gateways}' > /opt/gateways.yaml")
    running.shell(f"{ROOT}/deploy/install-service.sh /opt/alone.yaml /opt/gateways.yaml")
    yield running
    running.shell(f"{ROOT}/deploy/install-service.sh {SIM}; sed -i /^GATEWAYS_TABLE=/d /etc/default/rover-router")
    assert running.run("systemctl", "cat", "rover-gateways", check=False).returncode != 0


def test_gateways_run_in_a_process_that_can_do_nothing_to_the_router(apart: Machine) -> None:
    assert apart.state() == apart.state("rover-gateways") == "active"
    assert apart.show("UnitFileState", "rover-gateways") == "enabled"
    pids = {unit: apart.show("MainPID", unit) for unit in ("rover-router", "rover-gateways")}
    assert f"pid={pids['rover-gateways']}," in apart.shell("ss -ltnpH 'sport = :28765'")
    users = {unit: apart.shell(f"stat -c %u /proc/{pid}").strip() for unit, pid in pids.items()}
    assert "0" not in users.values()
    assert users["rover-router"] != users["rover-gateways"]
    own = users["rover-gateways"]
    as_gateways = f"HOME=/tmp setpriv --reuid={own} --regid={own} --clear-groups {ROUTER}"
    assert "only for user rover-router and root" in apart.shell(f"{as_gateways} reload -t /opt/alone.yaml", check=False)
    apart.run("systemctl", "reload", "rover-gateways")
    assert "gateways.yaml" in apart.journal("rover-gateways").rpartition("reload")[0]


def test_gateways_that_are_killed_come_back_and_the_router_runs_on(apart: Machine) -> None:
    before = {unit: apart.show("MainPID", unit) for unit in ("rover-router", "rover-gateways")}
    apart.shell("systemctl kill --signal=KILL --kill-whom=main rover-gateways")
    apart.wait_for(
        f"[ $(systemctl show -P MainPID rover-gateways) != {before['rover-gateways']} ]"
        " && systemctl is-active -q rover-gateways"
    )
    assert (apart.state(), apart.show("MainPID")) == ("active", before["rover-router"])


def test_one_gateway_is_not_in_two_services(running: Machine) -> None:
    finished = running.run(f"{ROOT}/deploy/install-service.sh", SIM, "/dev/null", check=False)
    assert finished.returncode == 1
    assert finished.stderr == (
        f"install-service: nothing was changed: {SIM} has gateways itself: leave out /dev/null,\n"
        "install-service: or name a table without gateways, such as routes/rover-router.yaml\n"
    )


def test_no_other_computer_is_looked_for_whatever_is_sourced(running: Machine) -> None:
    assert {"ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST", "FASTDDS_BUILTIN_TRANSPORTS=UDPv4"} <= running.environment()


def test_its_listener_is_systemds_socket(running: Machine) -> None:
    holders = running.shell("ss -lunp 'sport = :25000'")
    assert "127.0.0.5:25000" in holders
    assert '"systemd"' in holders
    assert f"pid={running.show('MainPID')}" in holders


def test_listeners_on_an_interface_have_a_socket_unit_of_their_own(running: Machine) -> None:
    table = f"""version: 1
extends: {SIM}
listen:
  rover: {{interface: lo}}
  radio: {{address: 127.0.0.6:25000}}
"""
    running.shell(f"printf '%s' '{table}' > /opt/two.yaml; {ROOT}/deploy/install-service.sh /opt/two.yaml")
    assert (
        running.state() == running.state("rover-router.socket") == running.state("rover-router-lo.socket") == "active"
    )
    assert running.show("BindToDevice", "rover-router-lo.socket") == "lo"
    holders = running.shell("ss -lunpH 'sport = :25000'").splitlines()
    assert sorted(line.split()[3] for line in holders) == ["127.0.0.5%lo:25000", "127.0.0.6:25000"]
    assert all('"systemd"' in line and f"pid={running.show('MainPID')}" in line for line in holders)
    running.shell(SEND)
    running.wait_for(f"{METRICS} | grep -q '^router_datagrams_received_total{{listener=\"rover\"}} 1'")
    assert "uses this inherited socket" not in running.journal().rpartition("router started")[2]
    running.shell(f"sed -i '/radio:/d' /opt/two.yaml; {ROOT}/deploy/install-service.sh")
    assert running.run("systemctl", "cat", "rover-router.socket", check=False).returncode != 0
    assert running.state() == running.state("rover-router-lo.socket") == "active"
    running.shell(f"{ROOT}/deploy/install-service.sh {SIM}")
    assert running.run("systemctl", "cat", "rover-router-lo.socket", check=False).returncode != 0
    assert running.state() == running.state("rover-router.socket") == "active"


def test_ipv6_listeners_have_sockets_of_systemd_but_not_at_link_local_addresses(running: Machine) -> None:
    """systemd would ignore an interface that is not there when it reads the unit."""
    table = f"""version: 1
envelope: {{protos: {ROOT}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
listen:
  old: {{address: 0.0.0.0:25000}}
  new: {{address: "[::]:25000"}}
  late: {{address: "[fe80::1%nowhere0]:25001"}}
endpoints: {{board: {{address: "[fd00::30]:8", kind: board}}, other: {{address: 10.0.0.1:8, kind: tool}}}}
routes: {{drive_diag: {{source: board, destinations: [other]}}}}
"""
    running.shell(f"cat > /opt/six.yaml <<'END'\n{table}END\n{ROOT}/deploy/install-service.sh /opt/six.yaml")
    assert running.state() == running.state("rover-router.socket") == "active"
    lines = running.shell("ss -lunpH 'sport = :25000'").splitlines()
    held = [line for line in lines if '"systemd"' in line]
    assert sorted(line.split()[3] for line in held) == ["0.0.0.0:25000", "[::]:25000"]
    assert all(f"pid={running.show('MainPID')}" in line for line in lines)
    assert "fe80" not in running.shell("systemctl cat rover-router.socket")
    told = running.journal().rpartition("install-service")[2]
    assert "uses this inherited socket" not in told
    assert "BindIPv6Only" not in told
    running.shell(f"{ROOT}/deploy/install-service.sh {SIM}")


BOARD = """import os, shutil, time
board, device = os.openpty()
shutil.chown(os.ttyname(device), "root", "dialout")
os.chmod(os.ttyname(device), 0o660)
os.symlink(os.ttyname(device), "/opt/uart")
time.sleep(3600)
"""
"""A serial device with the rights that udev gives it, at /opt/uart."""

DEVICES = ("/dev/null", "/dev/ttyS0", "/dev/kmsg")


def test_serial_lines_of_the_table_are_open_to_its_user_and_other_devices_are_not(running: Machine) -> None:
    line = "{serial: /opt/uart, baud: 115200, framing: cobs}"
    table = f"""version: 1
extends: {SIM}
listen: {{uart: {line}}}
endpoints: {{lander: {{listener: uart, kind: board}}}}
"""
    running.run("systemd-run", "--unit", "board", sys.executable, "-c", BOARD)
    running.wait_for("test -e /opt/uart")
    running.shell(f"printf '%s' '{table}' > /opt/line.yaml; {ROOT}/deploy/install-service.sh /opt/line.yaml")
    running.wait_for(f"{METRICS} | grep -q '^router_link_up{{endpoint=\"lander\"}} 1'")
    assert running.show("SupplementaryGroups") == "dialout"
    assert "/opt/uart" not in running.shell("systemctl cat rover-router.socket")
    own = f"/sys/fs/cgroup{running.show('ControlGroup')}/cgroup.procs"
    opened = {device: running.shell(f"echo $$ > {own}; exec 3< {device}", check=False) for device in DEVICES}
    assert {device for device, said in opened.items() if "not permitted" in said} == {"/dev/kmsg"}
    running.shell(f"{ROOT}/deploy/install-service.sh {SIM}; systemctl stop board; rm /opt/uart")
    assert (running.show("SupplementaryGroups"), running.show("PrivateDevices")) == ("", "yes")
    assert running.state() == "active"


def test_errors_of_dead_boards_leave_the_socket_as_it_is(running: Machine) -> None:
    """Nobody listens where the deadmen send; the kernel reports it at the socket, which systemd holds, too."""
    running.wait_for("journalctl --unit rover-router | grep -q 'nobody listens at'")
    running.shell("sleep 1")
    assert running.state("rover-router.socket") == running.state("rover-router-hold.service") == "active"
    assert running.show("Result", "rover-router.socket") == "success"


def test_it_routes_to_ros_nodes_of_another_user(running: Machine) -> None:
    """Under all of its restrictions, and past the memory that Fast DDS shares among one user's processes only."""
    # The checkout, or its interpreter, may be in a home that nobody else can enter.
    for place in (ROOT / ".venv", Path(sys.executable).resolve()):
        running.run("chmod", "o+x", *place.parents)
    heard = running.shell(
        f"(for i in $(seq 100); do {SEND}; sleep 0.1; done) >/dev/null 2>&1 & sending=$!\n"
        f"{ENVIRONMENT}; HOME=/tmp setpriv --reuid=65534 --regid=65534 --clear-groups "
        f"{ROUTER} listen topic://ph_data --type comms/msg/SensorBoardPHInfo --count 2; kill $sending"
    )
    assert heard.count("ph_value=7") == 2


def test_who_stops_it_has_it_stopped_and_what_comes_waits(running: Machine) -> None:
    running.shell("systemctl stop rover-router")
    running.shell(SEND)
    running.shell("sleep 1")
    assert running.state() == "inactive"
    running.shell("systemctl start rover-router")
    running.wait_for(f"{METRICS} | grep -q '^router_datagrams_received_total{{listener=\"rover\"}} [1-9]'")


def test_a_start_after_the_socket_was_stopped_too_begins_with_nothing(running: Machine) -> None:
    running.shell(f"systemctl stop rover-router; {SEND}; systemctl stop rover-router.socket")
    running.shell("systemctl start rover-router")
    assert running.state("rover-router.socket") == "active"
    assert '"systemd"' in running.shell("ss -lunp 'sport = :25000'")
    received = running.shell(f"{METRICS} | grep '^router_datagrams_received_total{{listener=\"rover\"}}'")
    assert received.split()[-1] == "0.0"


def test_a_killed_router_comes_back(running: Machine) -> None:
    before = running.show("MainPID")
    running.wait_for("ls /var/lib/rover-router/kept/*.program")
    running.shell("systemctl kill --signal=KILL --kill-whom=main rover-router")
    running.wait_for(
        f"[ $(systemctl show -P MainPID rover-router) != {before} ] && systemctl is-active -q rover-router"
    )
    assert 'start="kept"' in running.shell(f"{METRICS} | grep ^router_build_info")
    [kept] = running.shell("stat -c '%U %a' /var/lib/rover-router/kept").splitlines()
    assert kept == "rover-router 700"


def test_a_loop_of_crashes_ends(running: Machine) -> None:
    running.shell(
        "mkdir -p /run/systemd/system/rover-router.service.d\n"
        "printf '[Service]\\nType=exec\\nExecStart=\\nExecStart=/usr/bin/env no-such-program\\n' "
        "> /run/systemd/system/rover-router.service.d/test.conf; systemctl daemon-reload"
    )
    running.run("systemctl", "restart", "rover-router", check=False)
    running.wait_for("systemctl is-failed -q rover-router")
    running.shell("rm /run/systemd/system/rover-router.service.d/test.conf; systemctl daemon-reload")
    assert "Start request repeated too quickly" in running.journal()
    running.shell("systemctl reset-failed rover-router; systemctl start rover-router")
    assert running.state() == "active"


def test_a_router_that_stands_still_is_ended_by_the_watchdog_and_says_what_python_does(running: Machine) -> None:
    running.shell(
        "mkdir -p /run/systemd/system/rover-router.service.d\n"
        "printf '[Service]\\nWatchdogSec=2s\\n' > /run/systemd/system/rover-router.service.d/test.conf\n"
        "systemctl daemon-reload; systemctl restart rover-router"
    )
    before = running.show("MainPID")
    running.shell("sleep 2.5")
    assert running.show("MainPID") == before  # as it is fed, it lives
    running.shell(f"kill -STOP {before}")
    running.wait_for(
        f"[ $(systemctl show -P MainPID rover-router) != {before} ] && systemctl is-active -q rover-router"
    )
    running.shell("rm /run/systemd/system/rover-router.service.d/test.conf; systemctl daemon-reload")
    assert "Watchdog timeout" in running.journal()
    assert "Fatal Python error: Aborted" in running.journal()
    assert re.search(r"/router/\S+\.py\", line \d+ in ", running.journal())


def test_a_reload_takes_a_good_table_and_refuses_a_bad_one(running: Machine) -> None:
    before = running.show("MainPID")
    running.shell(f"cp {SIM} /opt/sim.yaml; echo '# changed' >> {SIM}; systemctl reload rover-router")
    running.shell(f"echo 'routs: {{}}' >> {SIM}")
    assert running.run("systemctl", "reload", "rover-router", check=False).returncode != 0
    running.shell(f"cp /opt/sim.yaml {SIM}")
    assert (running.state(), running.show("MainPID")) == ("active", before)
    assert "did you mean 'routes'?" in running.journal()


def test_a_start_that_may_succeed_later_is_tried_again_until_it_does(running: Machine) -> None:
    """Here another program has the port of its status page."""
    listening = "import socket; s = socket.create_server(('127.0.0.1', 29108)); s.accept()"
    running.run("systemctl", "stop", "rover-router")
    running.run("systemd-run", "--unit", "holder", sys.executable, "-c", listening)
    running.wait_for("ss -ltn | grep -q 127.0.0.1:29108")
    running.run("systemctl", "start", "--no-block", "rover-router")
    running.wait_for("test $(systemctl show --property NRestarts --value rover-router) -gt 2")
    assert "has the port" in running.journal()
    assert running.state() == "activating"
    running.run("systemctl", "stop", "holder")
    running.wait_for("systemctl is-active rover-router")


def test_a_bad_table_stops_it_for_good_with_what_to_do_and_datagrams_do_not_start_it(running: Machine) -> None:
    running.shell(f"cp {SIM} /opt/sim.yaml; echo 'routs: {{}}' >> {SIM}")
    running.run("systemctl", "restart", "rover-router", check=False)
    running.shell(f"cp /opt/sim.yaml {SIM}; {SEND}; sleep 1")
    assert running.state() == "failed"
    assert running.show("ExecMainStatus") == str(BAD_TABLE)
    assert running.show("NRestarts") == "0"
    assert running.state("rover-router.socket") == "active"
    assert "did you mean 'routes'?" in running.journal()
    assert "help: " in running.journal()
    running.shell("systemctl reset-failed rover-router; systemctl start rover-router")
    assert running.state() == "active"
