"""A router that forwards and brakes by what an earlier one has kept, before it has imported or compiled anything."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from time import sleep

import pytest

from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.service_manager import ServiceManager
from tests.acceptance.site import ROOT, RouterProcess, Site, key, site, total, udp, wait_until
from tests.ros.peers import Subscriber
from tests.tables import PROTOS

BAD_TABLE, NOT_NOW = 78, 1
HOSTS = {"driving_board": "127.0.0.222", "sensor_board": "127.0.0.30", "basestation": "127.0.0.10"}
HOST = "127.0.0.5"

TABLE = """\
version: 1
extends: base.yaml
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}
"""
BASE = """\
version: 1
envelope: {protos: protos, message: PBEnvelope, oneof: payload}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1h
    deadman:
      timeout: "${DEADMAN:-1h}"
      send: {manual_brake: {brake: true}}
      to: [driving_board]
      obeyed: {drive_diag: abs(front_left_motor.rpm) < 5, within: 30s}
  drive_diag: {source: driving_board, destinations: [basestation]}
  ph_info:
    source: sensor_board
    destinations: [basestation]
    topics:
      - topic: kept/ph
        type: std_msgs/msg/Float32
        qos: {durability: transient_local}
        fields: {data: ph_value}
"""
PARAMETERS = "/**: {ros__parameters: {deadman: 1h}}\n"


def envelope(case: str, **values: object) -> bytes:
    return sample(case, WIRE.envelopes.first.cases[case].message_class(**values)).datagram


def ph(number: float) -> bytes:
    return envelope("ph_info", ph_value=number)


DRIVE, BRAKE = envelope("manual_drive", forward_backward=50), envelope("manual_brake", brake=True)


class GatedRouter(RouterProcess):
    """With `gated` it stops before it imports or compiles, until `open_gate`; when this is made, it stands there."""

    module = "tests.acceptance.gated_router"

    def __init__(
        self, folder: Path, *arguments: object, gated: bool, within: Sequence[str] = (), **environment: str
    ) -> None:
        self._gate = folder / "gate"
        reached = folder / "gate.reached"
        reached.unlink(missing_ok=True)
        if gated:
            self._gate.touch()
        environment = {"STATE_DIRECTORY": str(folder / "state"), "GATE": str(self._gate), **environment}
        super().__init__(folder, *arguments, within=within, **environment)
        if gated:
            with self._or_killed():
                wait_until(lambda: reached.exists() or self.process.poll() is not None, "the gate")
                assert self.process.poll() is None, self.text()

    def open_gate(self) -> None:
        self._gate.unlink(missing_ok=True)

    def kill(self) -> None:
        """As a crash ends it."""
        assert self.stop(signal.SIGKILL) == -signal.SIGKILL

    def started(self) -> GatedRouter:
        """Opens the gate and waits for the start."""
        self.open_gate()
        wait_until(lambda: self.process.poll() is not None or bool(self.events("router started")), "the start")
        assert self.process.poll() is None, self.text()
        return self


@dataclass
class Rover:
    """A rover's files and sockets. `arguments` and `environment` are what its router is started with."""

    site: Site
    table: Path
    arguments: list[object]
    environment: dict[str, str] = field(default_factory=dict)
    within: Sequence[str] = ()
    _last: bytes = b""

    @property
    def folder(self) -> Path:
        return self.site.folder

    @contextmanager
    def router(self, *more: object, gated: bool = False, **environment: str) -> Iterator[GatedRouter]:
        """Started, or at its gate. It is killed at the end if it still runs then."""
        chosen = {**self.environment, **environment}
        self._last = b""
        router = GatedRouter(self.folder, *self.arguments, *more, gated=gated, within=self.within, **chosen)
        try:
            yield router if gated else router.started()
        finally:
            router.open_gate()
            if router.process.poll() is None:
                router.kill()

    def kept(self) -> list[Path]:
        """The files that are kept."""
        folder = self.folder / "state" / "kept"
        return sorted(folder.glob("*.program"))

    def tries(self) -> list[Path]:
        """What counts the starts with a kept program that have not come to their end."""
        return sorted(self.folder.glob("state/kept/*.tries"))

    def keep(self, **environment: str) -> None:
        """Starts a router and kills it once its program is kept. What it sent is received."""
        before = self._versions()
        with self.router(gated=False, **environment):
            wait_until(lambda: self._versions() != before, "a kept program")
        self.site.waiting()

    def _versions(self) -> set[tuple[str, int, int]]:
        with suppress(FileNotFoundError):  # the oldest went meanwhile
            return {(path.name, (at := path.stat()).st_ino, at.st_mtime_ns) for path in self.kept()}
        return set()

    @property
    def is_served(self) -> bool:
        """Whether somebody listens on its port. Of a router at its gate: whether it had a head start."""
        return is_bound(HOST, self.site.listen)

    def drive(self) -> None:
        self.site.send("basestation", DRIVE)

    def heard(self) -> bytes:
        """The next that the driving board gets. Brakes that follow each other are one: a start repeats its brake."""
        while (found := self.site.receive("driving_board")) == self._last == BRAKE:
            pass
        self._last = found
        return found


def after_brakes(board: socket.socket) -> bytes:
    """The next that a board gets, after any number of brakes of the start."""
    return next(each for each in iter(lambda: board.recv(1000), None) if each != BRAKE)


def is_bound(host: str, port: int) -> bool:
    address = f"{int.from_bytes(socket.inet_aton(host), 'little'):08X}:{port:04X}"
    return any(line.split()[1] == address for line in Path("/proc/net/udp").read_text().splitlines()[1:])


@contextmanager
def rover_in(folder: Path) -> Iterator[Rover]:
    folder.mkdir(exist_ok=True)
    with site(folder, HOSTS) as place:
        table = place.table(TABLE)
        (folder / "base.yaml").write_text(BASE)
        shutil.copytree(PROTOS, folder / "protos", ignore=shutil.ignore_patterns("*.lock.json"))
        yield Rover(place, table, [table])


@pytest.fixture
def rover(tmp_path: Path) -> Iterator[Rover]:
    with rover_in(tmp_path) as found:
        yield found


# What a head start does


def test_after_a_kill_while_driving_it_brakes_and_forwards_before_python_has_imported_anything(rover: Rover) -> None:
    rover.keep()
    with rover.router() as router:
        assert rover.heard() == BRAKE
        rover.drive()
        assert rover.heard() == DRIVE
        router.kill()
    with rover.router(gated=True) as router:
        assert rover.heard() == BRAKE
        rover.drive()
        assert rover.heard() == DRIVE
        rover.site.send("sensor_board", ph(1), ph(2))
        assert [rover.site.receive("basestation") for _ in range(2)] == [ph(1), ph(2)]
        router.started()
        rover.drive()
        assert rover.heard() == DRIVE
        assert router.stop(signal.SIGTERM) == 0
        assert rover.heard() == BRAKE
        assert rover.site.waiting() == {}
        assert not [line for line in router.log() if line["level"] not in ("info", "debug")]


def test_nothing_is_lost_or_doubled_or_overtaken_while_python_takes_over(rover: Rover) -> None:
    """Nor forwarded by the table's order only: one stream, from the head start until long after the start."""
    rover.keep()
    numbers, ended = count(), threading.Event()
    sent: list[int] = []

    def stream() -> None:
        while not ended.wait(0.001):
            sent.append(number := next(numbers))
            rover.site.send("sensor_board", ph(number))

    thread = threading.Thread(target=stream)
    with rover.router(gated=True) as router:
        thread.start()
        try:
            received = [rover.site.receive("basestation") for _ in range(50)]
            router.started()
            received += [rover.site.receive("basestation") for _ in range(500)]
        finally:
            ended.set()
            thread.join()
        received += [rover.site.receive("basestation") for _ in sent[len(received) :]]
        assert received == [ph(number) for number in sent]
        counted = key("datagrams_received", listener="rover")
        wait_until(lambda: rover.site.scrape()[counted] == len(sent), "the count of all")
        waiting = rover.site.waiting()
        assert {name: set(datagrams) for name, datagrams in waiting.items()} == {"driving_board": {BRAKE}}


def test_what_a_head_start_did_is_counted(rover: Rover) -> None:
    rover.keep()
    with rover.router(gated=True) as router:
        rover.drive()
        assert [rover.heard(), rover.heard()] == [BRAKE, DRIVE]
        rover.site.send("driving_board", DRIVE)  # from a board that no route takes it from
        rover.site.send("sensor_board", ph(1))
        assert rover.site.receive("basestation") == ph(1)
        router.started()
        counts = rover.site.scrape()
        assert counts[key("datagrams_received", listener="rover")] == 3
        assert total(counts, "datagrams_rejected") == 1
        assert total(counts, "datagrams_sent", destination="driving_board") == 1
        assert total(counts, "datagrams_sent", destination="basestation") == 1
        assert total(counts, "deadman_datagrams_sent") >= 1  # one each second until the command
        assert total(counts, "deadman_trips") == 0
        assert router.stop(signal.SIGTERM) == 0
        last = router.log()[-1]
        assert (last["event"], last["datagrams_received"], last["datagrams_sent"]) == ("router stopped", 3, 2)


def test_the_brakes_of_the_start_go_on_after_a_head_start_until_the_board_is_heard(rover: Rover) -> None:
    rover.keep()
    with rover.router(gated=True) as router:
        assert [rover.site.receive("driving_board") for _ in range(2)] == [BRAKE] * 2
        router.started()
        rover.site.waiting()
        assert rover.site.receive("driving_board") == BRAKE
        rover.site.send("driving_board", DRIVE)  # from a board that no route takes it from
        sleep(2.5)
        rover.site.waiting()  # the last one
        sleep(1.5)
        assert rover.site.waiting() == {}


def test_a_deadman_trips_during_a_head_start(rover: Rover) -> None:
    rover.keep(DEADMAN="200ms")
    with rover.router(gated=True, DEADMAN="200ms") as router:
        rover.drive()
        assert [rover.heard() for _ in range(3)] == [BRAKE, DRIVE, BRAKE]
        rover.site.send("driving_board", envelope("drive_diag", front_left_motor={"rpm": 1}))
        router.started()
        stopped = key("deadman_stopping_seconds_count", route="manual_drive", endpoint="driving_board")
        assert rover.site.samples()[stopped] == 1
        assert total(rover.site.scrape(), "deadman_trips") == 1
        rover.site.waiting()
        rover.drive()
        while (heard := rover.heard()) == BRAKE:
            pass
        assert [heard, rover.heard()] == [DRIVE, BRAKE]


def test_a_deadman_that_a_head_start_has_armed_trips_after_it(rover: Rover) -> None:
    rover.keep(DEADMAN="3s")
    with rover.router(gated=True, DEADMAN="3s") as router:
        rover.drive()
        assert [rover.heard(), rover.heard()] == [BRAKE, DRIVE]
        router.started()
        assert rover.heard() == BRAKE
        assert total(rover.site.scrape(), "deadman_trips") == 1


def test_a_latched_topic_gets_what_arrived_during_the_head_start(rover: Rover) -> None:
    rover.keep()
    with rover.router(gated=True) as router:
        rover.site.send("sensor_board", ph(6), ph(7))
        assert [rover.site.receive("basestation") for _ in range(2)] == [ph(6), ph(7)]
        router.started()
        late = Subscriber("kept/ph", "std_msgs/msg/Float32", "--transient-local")
        try:
            assert late.line() == "matched"
            assert [struct.unpack("<xxxxf", bytes.fromhex(late.line())) for _ in range(2)] == [(6.0,), (7.0,)]
        finally:
            late.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_during_a_head_start_stops_it_in_good_order(rover: Rover, number: signal.Signals) -> None:
    rover.keep()
    with rover.router(gated=True) as router:
        rover.drive()
        assert [rover.heard(), rover.heard()] == [BRAKE, DRIVE]
        router.process.send_signal(number)
        router.open_gate()
        assert router.wait() == 0, router.text()
        assert rover.heard() == BRAKE
        assert rover.site.waiting() == {}


def test_a_stop_at_any_moment_of_the_start_leaves_no_board_driving(rover: Rover) -> None:
    rover.keep()
    for pause in range(0, 100, 7):
        router = GatedRouter(rover.folder, *rover.arguments, gated=False)
        ended = threading.Event()

        def drive(ended: threading.Event = ended) -> None:
            while not ended.wait(0.001):
                rover.drive()

        driving = threading.Thread(target=drive)
        driving.start()
        sleep(pause / 1000)
        router.process.send_signal(signal.SIGTERM)
        code = router.wait()
        ended.set()
        driving.join()
        heard = rover.site.waiting().get("driving_board", [])
        assert code in (0, -signal.SIGTERM), router.text()
        assert DRIVE not in heard[-1:], (pause, code, router.text())


@contextmanager
def restarted_by_a_service_manager(rover: Rover) -> Iterator[tuple[ServiceManager, Path]]:
    """A router that was killed is at its gate again, whose file is given; three commands came in between."""
    gate = rover.folder / "gate"
    manager = ServiceManager(
        rover.folder, rover.table, (HOST, rover.site.listen), STATE_DIRECTORY=f"{rover.folder}/state", GATE=str(gate)
    )
    manager.module = "tests.acceptance.gated_router"
    with closing(manager):
        try:
            manager.start()
            manager.hear("READY=1")
            wait_until(lambda: bool(rover.kept()), "a kept program")
            manager.end(signal.SIGKILL)
            rover.site.waiting()
            for _ in range(3):
                rover.drive()
            gate.touch()
            manager.start()
            yield manager, gate
        finally:
            gate.unlink(missing_ok=True)


def test_a_service_managers_sockets_are_served_in_the_order_of_arrival_behind_the_brake(rover: Rover) -> None:
    with restarted_by_a_service_manager(rover) as (manager, gate):
        assert [rover.heard() for _ in range(4)] == [BRAKE, *[DRIVE] * 3]
        gate.unlink()
        manager.hear("READY=1")
        assert manager.end(signal.SIGTERM) == 0
        assert rover.heard() == BRAKE
        assert rover.site.waiting() == {}


def test_a_service_managers_sockets_serve_another_table_after_the_head_start(rover: Rover) -> None:
    with udp("127.0.0.222") as other, restarted_by_a_service_manager(rover) as (manager, gate):
        assert [rover.heard() for _ in range(4)] == [BRAKE, *[DRIVE] * 3]
        port = rover.site.endpoints["driving_board"].getsockname()[1]
        rover.table.write_text(rover.table.read_text().replace(f":{port}", f":{other.getsockname()[1]}"))
        gate.unlink()
        manager.hear("READY=1")
        assert other.recv(1000) == BRAKE
        rover.drive()
        assert after_brakes(other) == DRIVE
        assert rover.site.waiting() == {"driving_board": [BRAKE]}


def test_a_reload_keeps_the_new_program(rover: Rover) -> None:
    rover.keep()
    with rover.router() as router, udp("127.0.0.222") as other:
        [before] = rover.kept()
        inode = before.stat().st_ino
        port = rover.site.endpoints["driving_board"].getsockname()[1]
        rover.table.write_text(rover.table.read_text().replace(f":{port}", f":{other.getsockname()[1]}"))
        router.process.send_signal(signal.SIGHUP)
        wait_until(lambda: [path.stat().st_ino for path in rover.kept()] != [inode], "the new program")
        router.kill()
        rover.site.waiting()
        with rover.router(gated=True):
            assert rover.is_served
            assert other.recv(1000) == BRAKE
            rover.drive()
            while (datagram := other.recv(1000)) == BRAKE:
                pass
            assert datagram == DRIVE
            assert "driving_board" not in rover.site.waiting()


def test_no_cache_neither_uses_nor_keeps_a_program(rover: Rover) -> None:
    rover.keep()
    with rover.router("--no-cache", gated=True):
        assert not rover.is_served
    before = [path.stat() for path in rover.kept()]
    with rover.router("--no-cache") as router:
        assert router.stop(signal.SIGTERM) == 0
    assert [path.stat() for path in rover.kept()] == before


def test_two_routers_with_one_cache_have_each_their_own(rover: Rover, tmp_path: Path) -> None:
    with rover_in(tmp_path / "second") as second:
        state = {"STATE_DIRECTORY": str(rover.folder / "state")}
        second.environment = state
        rover.keep()
        with second.router():
            wait_until(lambda: len(rover.kept()) == 2, "a second kept program")
        second.site.waiting()
        with rover.router(gated=True) as one, second.router(gated=True) as two:
            for each in (rover, second):
                each.drive()
                assert [each.heard(), each.heard()] == [BRAKE, DRIVE]
            one.started()
            two.started()
            assert rover.site.waiting() == second.site.waiting() == {}


# When there is none


def test_a_second_router_of_one_table_does_not_touch_the_boards_of_the_first(rover: Rover) -> None:
    rover.keep()
    with rover.router() as first:
        assert rover.heard() == BRAKE
        rover.drive()
        assert rover.heard() == DRIVE
        (rover.folder / "other").mkdir()
        second = GatedRouter(
            rover.folder / "other", rover.table, gated=False, STATE_DIRECTORY=str(rover.folder / "state")
        )
        assert second.wait() == NOT_NOW
        assert "has the port" in second.text()
        assert rover.site.waiting() == {}
        rover.drive()
        assert rover.heard() == DRIVE
        assert first.process.poll() is None


def test_a_start_that_fails_after_its_head_start_leaves_the_board_halted(rover: Rover) -> None:
    """Here another program has its port of TCP."""
    rover.keep()
    with socket.create_server(("127.0.0.1", rover.site.metrics)), rover.router(gated=True) as router:
        rover.drive()
        assert [rover.heard(), rover.heard()] == [BRAKE, DRIVE]
        router.open_gate()
        assert router.wait() == NOT_NOW
        assert rover.site.waiting() == {"driving_board": [BRAKE]}


def test_a_table_that_changes_during_the_head_start_is_what_drives_in_the_end(rover: Rover) -> None:
    rover.keep()
    port = rover.site.endpoints["driving_board"].getsockname()[1]
    with udp("127.0.0.222") as other, rover.router(gated=True) as router:
        rover.drive()
        assert [rover.heard(), rover.heard()] == [BRAKE, DRIVE]
        rover.table.write_text(rover.table.read_text().replace(f":{port}", f":{other.getsockname()[1]}"))
        router.started()
        assert other.recv(1000) == BRAKE
        rover.drive()
        assert after_brakes(other) == DRIVE
        assert rover.site.waiting() == {"driving_board": [BRAKE]}


def test_a_table_that_is_broken_during_the_head_start_ends_it_with_the_board_halted(rover: Rover) -> None:
    rover.keep()
    with rover.router(gated=True) as router:
        rover.drive()
        assert [rover.heard(), rover.heard()] == [BRAKE, DRIVE]
        rover.table.write_text("version: 7\n")
        router.open_gate()
        assert router.wait() == BAD_TABLE
        assert "error[" in router.text()
        assert rover.site.waiting() == {"driving_board": [BRAKE]}


# Files that are not used


def flip(path: Path, at: float) -> None:
    content = bytearray(path.read_bytes())
    content[int(at * (len(content) - 1))] ^= 0x10
    path.write_bytes(content)


def cut(path: Path, at: float) -> None:
    os.truncate(path, int(at * path.stat().st_size))


def replaced(path: Path, make: Callable[[Path], object]) -> None:
    aside = path.rename(path.parent.parent / "aside")
    make(path)
    assert aside.exists()


DAMAGE: dict[str, Callable[[Path], object]] = {
    **{f"a bit flipped at {at:g}": partial(flip, at=at) for at in (0, 0.0001, 0.01, 0.1, 0.5, 0.9, 1)},
    **{f"cut at {at:g}": partial(cut, at=at) for at in (0, 0.0001, 0.5, 0.99999)},
    "longer": lambda path: path.open("ab").write(b"\0"),
    "of another user": lambda path: os.chown(path, 65534, -1),
    "writable by others": lambda path: path.chmod(0o666),
    "a link": lambda path: replaced(path, lambda there: there.symlink_to(path.parent.parent / "aside")),
    "a folder": lambda path: replaced(path, Path.mkdir),
    "a pipe": lambda path: replaced(path, lambda there: os.mkfifo(there, 0o600)),
    "a socket": lambda path: replaced(path, lambda there: os.mknod(there, 0o600 | 0o140000)),
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    """A rover whose program is kept; its router is not running. Tests leave it so."""
    with rover_in(tmp_path_factory.mktemp("kept")) as found:
        found.keep()
        yield found


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_file_that_is_not_as_it_was_written_is_not_used(kept: Rover, damage: Callable[[Path], object]) -> None:
    if damage is DAMAGE["of another user"] and os.geteuid():
        pytest.skip("needs root")
    [path] = kept.kept()
    content = path.read_bytes()
    damage(path)
    try:
        with kept.router(gated=True) as router:
            assert not kept.is_served
            router.started()
            [told] = router.events("the kept program is not used: the table is compiled first")
            assert told["why"]
            assert kept.heard() == BRAKE
    finally:
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        path.unlink(missing_ok=True)
        path.write_bytes(content)
        path.chmod(0o600)
        (path.parent.parent / "aside").unlink(missing_ok=True)
        kept.site.waiting()
    assert_used(kept)


def test_a_file_with_which_routers_die_is_used_no_more_until_one_has_started(rover: Rover) -> None:
    rover.keep()
    used, has_ended = 0, False
    while not has_ended:
        with rover.router(gated=True) as router:
            if rover.is_served:
                used += 1
                continue
            router.started()
            assert len(router.events("the kept program is not used: the table is compiled first")) == 1
            wait_until(lambda: not rover.tries(), "the kept program")
            has_ended = True
    assert 0 < used < 20  # as often as systemd tries
    with rover.router(gated=True) as router:
        assert rover.is_served
        assert rover.tries()
        router.started()
        wait_until(lambda: not rover.tries(), "the end of trying")


def test_a_file_of_another_table_in_its_place_is_not_used(kept: Rover, tmp_path: Path) -> None:
    [path] = kept.kept()
    content = path.read_bytes()
    with rover_in(tmp_path) as other:
        other.keep()
        shutil.copyfile(other.kept()[0], path)
        try:
            with kept.router(gated=True):
                assert not kept.is_served
                assert not is_bound(HOST, other.site.listen)
                assert other.site.waiting() == {}
        finally:
            path.write_bytes(content)
    assert_used(kept)


def test_a_folder_that_cannot_be_written_to_costs_a_line_and_no_more(rover: Rover) -> None:
    with rover.router(STATE_DIRECTORY="/sys") as router:
        wait_until(lambda: any("kept" in line["event"] for line in router.log()), "the line")
        assert rover.heard() == BRAKE
        router.process.send_signal(signal.SIGHUP)
        wait_until(lambda: bool(router.events("table reloaded")), "a reload")
        assert router.stop(signal.SIGTERM) == 0
        assert [line["level"] for line in router.log() if "kept" in line["event"]] == ["warning"]


def assert_used(rover: Rover) -> None:
    """So that the test before has not only shown that nothing is ever used."""
    for path in rover.tries():  # tests have many in a minute
        path.unlink()
    with rover.router(gated=True):
        assert rover.is_served
        assert rover.heard() == BRAKE
    rover.site.waiting()


# Edits between two starts


def added(path: str, text: str = "") -> Callable[[Rover], None]:
    """A file that was not there."""

    def edit(rover: Rover) -> None:
        target = rover.folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        assert not target.exists()
        target.write_text(text)

    return edit


def appended(path: str, text: str) -> Callable[[Rover], None]:
    def edit(rover: Rover) -> None:
        with (rover.folder / path).open("a") as file:
            file.write(text)

    return edit


def removed(path: str) -> Callable[[Rover], None]:
    return lambda rover: (rover.folder / path).unlink()


def piped(path: str) -> Callable[[Rover], None]:
    """A pipe to which nobody writes in the place of a file."""

    def edit(rover: Rover) -> None:
        (rover.folder / path).unlink()
        os.mkfifo(rover.folder / path)

    return edit


def relinked(rover: Rover) -> None:
    (rover.folder / "linked").unlink()
    (rover.folder / "linked").symlink_to("other")


def with_variable(**variables: str) -> Callable[[Rover], None]:
    return lambda rover: rover.environment.update(
        {name: value.format(rover.folder) for name, value in variables.items()}
    )


def without_variable(name: str) -> Callable[[Rover], None]:
    return lambda rover: rover.environment.__delitem__(name)


ENVELOPE = "protos/components/common/envelope.proto"
EDITS = {
    "a comment in the table": appended("table.yaml", "# changed\n"),
    "a comment in a table that is extended": appended("base.yaml", "# changed\n"),
    "a comment in a proto": appended(ENVELOPE, "// changed\n"),
    "a new proto": added("protos/new.proto", 'syntax = "proto3";\n'),
    "a new proto in a new folder": added("protos/new/new.proto", 'syntax = "proto3";\n'),
    "a proto that is gone": removed("protos/components/basestation/object_selection.proto"),
    "a pipe in the place of the table": piped("table.yaml"),
    "a pipe in the place of a proto": piped(ENVELOPE),
    "a lock that appears": added("protos/envelope.lock.json", "{}"),
    "limits of boards that appear": added("protos/components/common/envelope.options", ""),
    "another variable of the table": with_variable(GIVEN="best_effort"),
    "a variable that is gone": without_variable("GIVEN"),
    "another table of ROUTER_TABLE": with_variable(ROUTER_TABLE="{0}/other.yaml"),
    "another parameter in a file of ROS": appended("parameters.yaml", "# changed\n"),
    "a message that shadows another": added("prefix/share/std_msgs/msg/Float32.msg", "float32 data\n"),
    "another workspace": with_variable(AMENT_PREFIX_PATH="{0}/other"),
    "another ROS domain": with_variable(ROS_DOMAIN_ID="100"),
    "another middleware": with_variable(RMW_IMPLEMENTATION="rmw_fastrtps_cpp"),
    "a link that leads elsewhere": relinked,
}


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    """A rover with everything that a table can depend on, its program kept."""
    with rover_in(tmp_path_factory.mktemp("edited")) as found:
        folder = found.folder
        (folder / "parameters.yaml").write_text(PARAMETERS)
        (folder / "other.yaml").write_text(found.table.read_text())
        for name in ("one", "other"):
            (folder / name).mkdir()
            (folder / name / "part.yaml").write_text(f"version: 1  # {name}\nextends: ../base.yaml\n")
        (folder / "linked").symlink_to("one")
        found.table.write_text(found.table.read_text().replace("base.yaml", "linked/part.yaml"))
        base = BASE.replace("transient_local}", 'transient_local, reliability: "${GIVEN:-reliable}"}')
        (folder / "base.yaml").write_text(base)
        found.arguments = ["--ros-args", "--params-file", folder / "parameters.yaml"]
        prefixes = f"{folder}/prefix:{os.environ.get('AMENT_PREFIX_PATH', '')}"
        found.environment = {"ROUTER_TABLE": str(found.table), "AMENT_PREFIX_PATH": prefixes, "GIVEN": "reliable"}
        found.keep()
        yield found


@contextmanager
def restored(rover: Rover) -> Iterator[None]:
    """The rover's files and environment are as before at the end."""
    environment, aside = dict(rover.environment), rover.folder.with_name(f"{rover.folder.name}-aside")
    shutil.copytree(rover.folder, aside, symlinks=True)
    try:
        yield
    finally:
        rover.environment = environment
        for path in rover.folder.iterdir():
            if path.name != "state":
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        for path in aside.iterdir():
            if path.name != "state":
                path.rename(rover.folder / path.name)
        shutil.rmtree(aside)


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_after_an_edit_the_old_program_is_not_used(edited: Rover, edit: Callable[[Rover], None]) -> None:
    with restored(edited):
        edit(edited)
        with edited.router(gated=True):
            assert not edited.is_served
            assert edited.site.waiting() == {}
    assert_used(edited)


def test_another_argument_is_another_program(kept: Rover) -> None:
    with kept.router("--ros-args", "-p", "deadman:=200ms", gated=True):
        assert not kept.is_served


def test_after_an_edit_the_new_table_drives(rover: Rover) -> None:
    rover.keep()
    with udp("127.0.0.222") as other:
        old = rover.site.endpoints["driving_board"].getsockname()[1]
        rover.table.write_text(rover.table.read_text().replace(f":{old}", f":{other.getsockname()[1]}"))
        with rover.router(gated=True) as router:
            router.started()
            rover.drive()
            assert other.recv(1000) == BRAKE
            assert after_brakes(other) == DRIVE
            assert rover.site.waiting() == {}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    """A rover with a copy of the router's code, its program kept."""
    copy = tmp_path_factory.mktemp("package")
    ignored = shutil.ignore_patterns("__pycache__")  # other tests write there
    for name in ("router", "schemas"):
        shutil.copytree(ROOT / name, copy / name, ignore=ignored)
    with rover_in(tmp_path_factory.mktemp("rover")) as found:
        found.within = ("/usr/bin/env", "-C", str(copy))
        found.environment = {"PYTHONPATH": str(copy)}
        found.keep()
        yield found


CODE = {
    "touched": lambda code: os.utime(code / "compiler" / "check.py"),
    "added": lambda code: (code / "compiler" / "new.py").touch(),
    "gone": lambda code: (code / "tools" / "graph.py").unlink(),
}


@pytest.mark.parametrize("change", CODE.values(), ids=CODE)
def test_other_code_of_the_router_does_not_use_what_was_kept(package: Rover, change: Callable[[Path], object]) -> None:
    code = Path(package.environment["PYTHONPATH"]) / "router"
    assert_used(package)
    change(code)
    with package.router(gated=True):
        assert not package.is_served
    package.keep()
