"""The tunnel of deploy/wireguard, by a real WireGuard: what comes through it drives, what passes it does not."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from router.compiler import check_table
from tests.acceptance.site import ROOT, wait_until
from tests.acceptance.two_networks import DRIVE, LAN, RADIO, Rover, attacker, rover_with_networks, udp
from tests.tables import PROTOS, ROUTES

pytestmark = pytest.mark.slow

KEYS = ROOT / "deploy" / "wireguard" / "keys.sh"
STATION, ROVER = ("10.77.0.10", 9000), ("10.77.0.1", 5000)
TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen:
  rover: {{address: 0.0.0.0:5000, interface: lan0}}
  radio: {{address: 0.0.0.0:5000, interface: wg0}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board}}
  basestation: {{address: 10.77.0.10:9000, kind: basestation, listener: radio}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1s
    deadman: {{timeout: 1200ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], repeat: 10s}}
  drive_diag: {{source: driving_board, destinations: [basestation]}}
"""


def make_keys(folder: Path, *arguments: str, check: bool = True) -> str:
    if shutil.which("wg") is None:
        pytest.skip("needs wg, of wireguard-tools")
    finished = subprocess.run(
        [KEYS, *arguments], capture_output=True, text=True, check=False, env={**os.environ, "KEYS": str(folder)}
    )
    assert (finished.returncode == 0) == check, finished.stdout + finished.stderr
    return finished.stdout + finished.stderr


def test_keys_are_nobody_elses_and_stay_when_a_basestation_is_added(tmp_path: Path) -> None:
    make_keys(tmp_path, "192.168.1.20")
    before = {path: path.read_text() for path in tmp_path.glob("*/wg0.conf")}
    assert {path.parent.name for path in before} == {"rover", "basestation"}
    assert "10.77.0.11" in make_keys(tmp_path, "192.168.1.20", "second")
    after = {path: path.read_text() for path in tmp_path.glob("*/wg0.conf")}
    assert all(after[path].startswith(text) for path, text in before.items())
    assert after[tmp_path / "rover/wg0.conf"].count("[Peer]") == 2
    assert {stat.S_IMODE(path.stat().st_mode) for path in after} == {0o600}
    assert {stat.S_IMODE(path.parent.stat().st_mode) for path in after} == {0o700}
    assert len(set(re.findall("PrivateKey = (.*)", "".join(after.values())))) == 3
    assert "already has keys" in make_keys(tmp_path, "192.168.1.20", "second", check=False)
    assert {path: path.read_text() for path in after} == after


def test_keys_are_not_for_git() -> None:
    assert "deploy/wireguard/keys/" in (ROOT / ".gitignore").read_text().splitlines()


def test_the_rovers_tables_are_ready_for_the_tunnel(tmp_path: Path) -> None:
    """Each line that begins with `#name:` is taken in place of the one of that name."""
    for name in ("rover.yaml", "sim.yaml"):
        lines = (ROUTES / name).read_text().replace("../protos", str(PROTOS)).splitlines()
        prepared = {found[2] for line in lines if (found := re.match(r"( +)#([a-z]+): +{", line))}
        assert prepared >= {"rover", "radio"}
        kept = [line for line in lines if not any(re.match(f" +{name}: +{{", line) for name in prepared)]
        (tmp_path / name).write_text("\n".join(re.sub(r"^( +)#([a-z]+: +{)", r"\1\2", line) for line in kept) + "\n")
    rover, sim = (check_table(tmp_path / name, {}) for name in ("rover.yaml", "sim.yaml"))
    assert (list(rover.diagnostics), list(sim.diagnostics)) == ([], [])
    for checked, where in ((rover, {"eth0", "wg0"}), (sim, {"lo"})):
        assert checked.program is not None
        assert {listener.interface for listener in checked.program.listeners} == where
        basestation = checked.program.table.endpoints["basestation"]
        assert basestation.listener is not None
        assert basestation.listener.value == "radio"


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    """The control sockets of all tunnels are in /var/run/wireguard, which namespaces and other test runs share."""
    with Path(tempfile.gettempdir(), "router-tests-wireguard.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Rover]:
    """With the tunnel up: `wg0` on the rover, and as `wg1` on the basestation, for both have one /run."""
    for tool in ("wg", "wg-quick"):
        if shutil.which(tool) is None:
            pytest.skip(f"needs {tool}, of wireguard-tools")
    make_keys(tmp_path, RADIO[0])
    (tmp_path / "wg0.conf").write_text((tmp_path / "rover/wg0.conf").read_text())
    (tmp_path / "wg1.conf").write_text((tmp_path / "basestation/wg0.conf").read_text())
    (tmp_path / "wg0.conf").chmod(0o600)
    (tmp_path / "wg1.conf").chmod(0o600)
    with _one_at_a_time(), rover_with_networks(tmp_path) as found, ExitStack() as ending:
        for computer, name in ((found.rover, "wg0"), (found.radio, "wg1")):
            said = computer.run("wg-quick", "up", tmp_path / f"{name}.conf", check=False)
            if name not in computer.run("wg", "show", "interfaces"):
                pytest.skip(f"no WireGuard here, neither the kernel's nor wireguard-go: {said}")
            ending.callback(computer.run, "wg-quick", "down", tmp_path / f"{name}.conf")
        yield found


def test_a_command_drives_through_the_tunnel_and_a_forged_one_past_it_does_not(site: Rover) -> None:
    with site.router(TABLE), ExitStack() as stack:
        station = stack.enter_context(udp(site.radio, STATION))
        station.sendto(DRIVE, ROVER)
        wait_until(lambda: site.board_gets() == [DRIVE], "the command through the tunnel")
        # Who is on the radio has the basestation's address in the tunnel, and no key. No listener has that interface.
        site.radio.run("wg-quick", "down", site.folder / "wg1.conf")
        on_radio = attacker(site, stack, site.radio, STATION)
        site.radio.ip("route", "replace", ROVER[0], "via", RADIO[0], "dev", "eth0")
        for address in (ROVER, RADIO):
            on_radio.sendto(DRIVE, address)
        # Who is in the LAN reaches a listener, which does not believe him.
        on_lan = attacker(site, stack, site.lan, STATION)
        site.lan.ip("route", "replace", ROVER[0], "via", LAN[0], "dev", "eth0")
        for address in (ROVER, LAN):
            on_lan.sendto(DRIVE, address)
        wait_until(lambda: site.mismatches("rover") == 2, "the forged commands from the LAN")
        assert site.board_gets() == []
        assert site.count("datagrams_received_total", listener="radio") == 1
        for process in (on_radio, station):
            process.close()
        site.radio.ip("address", "del", f"{STATION[0]}/32", "dev", "eth0")
        site.radio.ip("route", "del", ROVER[0])
        site.radio.run("wg-quick", "up", site.folder / "wg1.conf")
        again = stack.enter_context(udp(site.radio, STATION))

        def drives() -> bool:
            again.sendto(DRIVE, ROVER)
            return DRIVE in site.board_gets()

        wait_until(drives, "the basestation's return")


def test_a_tunnel_that_is_set_up_again_needs_no_new_router(site: Rover) -> None:
    with site.router(TABLE) as router, ExitStack() as stack:
        station = stack.enter_context(udp(site.radio, STATION))
        site.rover.run("wg-quick", "down", site.folder / "wg0.conf")
        gone = "the network interface is gone: the listener receives nothing"
        wait_until(lambda: bool(router.events(gone)), "the loss")
        site.rover.run("wg-quick", "up", site.folder / "wg0.conf")
        wait_until(lambda: bool(router.events("these listeners now receive: their networks are up")), "the return")

        def drives() -> bool:
            station.sendto(DRIVE, ROVER)
            return DRIVE in site.board_gets()

        wait_until(drives, "the command")


def test_the_firewall_lets_the_tunnel_through_and_nothing_else(site: Rover) -> None:
    rules = (ROOT / "deploy" / "wireguard" / "rover.nft").read_text().replace("wlan0", "radio0")
    (site.folder / "rover.nft").write_text(rules)
    site.rover.nft("-f", site.folder / "rover.nft")
    with ExitStack() as stack:
        station = stack.enter_context(udp(site.radio, STATION))
        through = stack.enter_context(udp(site.rover, ROVER))
        station.sendto(b"through", ROVER)
        assert through.recv(100) == b"through"
        past = stack.enter_context(udp(site.rover, RADIO))
        past.settimeout(0.2)
        site.basestation.sendto(b"past", RADIO)
        with pytest.raises(TimeoutError):
            past.recv(100)
