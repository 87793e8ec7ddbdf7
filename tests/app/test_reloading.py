"""Reloads of a whole router in this process, while datagrams come: what is kept, what is counted, what is refused."""

from __future__ import annotations

import functools
import gc
import os
import random
import re
import shutil
import socket
import threading
import weakref
from collections.abc import Callable
from time import sleep, time
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import ANY
from urllib.request import urlopen

import pytest
from structlog.testing import capture_logs

from router.app import Router, reloading, watching
from router.app.change import Change
from router.app.counts import ThreadCounts
from router.app.plane import Plane
from router.app.watching import watched_files
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Counters
from router.observe.http import HttpServer
from router.observe.snapshot import Snapshot, parse_metrics, snapshot
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, Site, let_rest, numbered, udp
from tests.ports import free_port
from tests.tables import PROTOS

PH = "  ph_info: {source: sensor_board, destinations: [basestation]}\n"
TOPIC = """\
  ph_info:
    source: sensor_board
    destinations: [basestation]
    topics: [{topic: ph, type: comms/msg/SensorBoardPHInfo, queue_depth: 10, fields: auto}]
"""


def turns(timeout: str, at_start: str = "silent") -> str:
    deadman = f"timeout: {timeout}, send: {{manual_brake: {{brake: true}}}}, to: [basestation], repeat: 10ms"
    return f"""\
  manual_drive:
    source: sensor_board
    destinations: [basestation]
    deadman: {{{deadman}, at_start: {at_start}}}
"""


def operator(port: int, timeout: str) -> str:
    """A gateway that lets a topic in."""
    return f"""\
gateways:
  operator:
    transport: {{tcp: 127.0.0.1:{port}}}
    format: json_lines
    inbound:
      - topic: word
        type: std_msgs/msg/Bool
        deadman: {{timeout: {timeout}, send: {{data: false}}}}
"""


def write_while_it_waits(monkeypatch: pytest.MonkeyPatch, write: Callable[[], object]) -> None:
    """Write when a reload begins to wait for files that may still be written, as a slow copy goes on."""
    writes = iter([write])

    def wait(seconds: float) -> None:
        for each in writes:
            each()
        sleep(seconds)

    monkeypatch.setattr(watching, "sleep", wait)


def numbers(router: Router) -> Snapshot:
    return snapshot(router.collect(), 0)


def reloads(router: Router, result: str) -> float:
    return numbers(router).total("config_reloads", result)


def test_the_table_of_the_start_counts_as_loaded_from_the_first_scrape(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    scrapes: list[Snapshot] = []

    class Scraped(HttpServer):
        """Its first client is there as soon as the port answers, before anything is received."""

        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            with urlopen(f"http://{self.address}/metrics") as answer:
                scrapes.append(parse_metrics(answer.read().decode(), time()))

    monkeypatch.setattr("router.observe.http.HttpServer", Scraped)
    began = time()
    with site.router(f'{PH}http: {{address: "127.0.0.1:{free_port()}"}}\n'):
        [first] = scrapes
    assert first.total("config_last_reload_successful") == 1
    assert began - 60 < first.total("config_last_reload_timestamp_seconds") <= time()


def test_nothing_is_lost_or_doubled_or_out_of_order_while_tables_change(site: Site) -> None:
    choice = random.Random(6)
    rover = f'address: "127.0.0.1:{site.listen}"'
    tool = '  tool: {address: "127.0.0.1:9", kind: tool}\n'
    with site.router(PH) as router:
        first = router.listeners["rover"].socket
        with site.under_load():
            for _ in range(25):
                listen = choice.choice([f"  rover: {{{rover}}}", f"  other: {{{rover}, receive_buffer: 2MiB}}"])
                routes = choice.choice([PH, TOPIC, PH + turns("1s"), PH.replace("}", ", ttl: 5s}")])
                site.write(routes, listen=listen, endpoints=choice.choice(["", tool]))
                assert router.reload().ok
                assert next(iter(router.listeners.values())).socket is first
    site.take()
    assert site.received == site.sent
    assert router.total("datagrams_received") == len(site.sent)
    assert router.total("datagrams_sent") == len(site.sent)
    assert router.total("config_reloads") == 25


def test_a_table_with_errors_changes_nothing_and_is_told(site: Site) -> None:
    with site.router(PH) as router:
        before = router.program
        site.write(PH.replace("basestation", "nobody"))
        result = router.reload()
        assert (result.ok, result.text) == (False, "the table has 1 error")
        assert "nobody" in str(result.findings[-1])
        assert router.program is before
        assert numbers(router).total("config_last_reload_successful") == 0
        assert reloads(router, "invalid") == 1
        site.send(numbered(3))
        assert site.basestation.recv(1000) == numbered(3)
        site.write(PH)
        assert router.reload().text == "nothing changed"
        assert numbers(router).total("config_last_reload_successful") == 1


def test_what_cannot_be_opened_changes_nothing(site: Site) -> None:
    with site.router(PH) as router, udp("127.0.0.1") as taken:
        both = (
            f'  rover: {{address: "127.0.0.1:{site.listen}"}}\n'
            f'  second: {{address: "127.0.0.1:{taken.getsockname()[1]}"}}'
        )
        site.write(PH, listen=both)
        result = router.reload()
        assert not result.ok
        assert "has the port" in result.text
        assert "no route for the payload cases" in str(result.findings[0])  # warnings are told all the same
        assert reloads(router, "failed") == 1
        assert list(router.listeners) == ["rover"]
        site.write(PH, listen=f'  rover: {{address: "0.0.0.0:{site.listen}"}}')
        assert f"the router itself (pid {os.getpid()}) has the port; restart it" in router.reload().text


def test_what_only_a_start_can_change_is_refused(site: Site) -> None:
    with site.router(PH) as router:
        path = site.write(PH)
        unchanged = path.read_text()
        for node in ("name: another", "diagnostics: true"):
            path.write_text(f"{unchanged}node: {{{node}}}\n")
            result = router.reload()
            assert not result.ok
            assert "table.yaml:10:1: error[bad-value]: 'node' cannot change while the router runs; restart it" in str(
                result.findings[-1]
            )


def test_what_has_arrived_on_a_listener_that_goes_is_routed_before_it_goes(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = free_port()
    both = f'  rover: {{address: "127.0.0.1:{site.listen}"}}\n  second: {{address: "127.0.0.1:{second}"}}'
    with site.router(PH) as router:
        site.write(PH, listen=both)
        assert router.reload().ok
        adopt = Plane.adopt

        def adopt_late(plane: Plane, *change: Any) -> None:
            site.send(*map(numbered, range(50)), port=second)
            adopt(plane, *change)

        monkeypatch.setattr(Plane, "adopt", adopt_late)
        site.write(PH)
        assert router.reload().ok
        assert [site.basestation.recv(1000) for _ in range(50)] == [numbered(number) for number in range(50)]
        assert (
            numbers(router).total("datagrams_received", "second") == 50
        )  # what happened does not vanish with who it happened to


def test_a_deadman_stays_armed_when_its_table_is_reloaded(site: Site) -> None:
    with site.router(turns("300ms")) as router:
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE
        site.write(turns("300ms") + PH)
        assert router.reload().ok
        assert site.basestation.recv(1000) == BRAKE


def test_a_deadman_with_another_timeout_inherits_the_last_command(site: Site) -> None:
    with site.router(turns("1h")) as router:
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE
        site.write(turns("50ms"))
        assert router.reload().ok
        assert site.basestation.recv(1000) == BRAKE
        site.write(turns("60ms"))  # tripped
        assert router.reload().ok
        assert router.total("deadman_active") == 1
        site.send(DRIVE)
        while site.basestation.recv(1000) != DRIVE:
            pass
        assert site.basestation.recv(1000) == BRAKE
        wait_until(lambda: router.total("deadman_trips") == 2)


SECOND = """\
  manual_drive:
    - source: sensor_board
      destinations: [basestation]
      deadman: &halt {timeout: TIMEOUT, send: {manual_brake: {brake: true}}, repeat: 10ms, at_start: silent}
    - {source: basestation, destinations: [sensor_board], deadman: {none: it is answered}}
"""
"""`turns`, with a second route of the case, which renames the first one."""


def test_a_second_route_of_its_case_does_not_stop_what_drives(site: Site) -> None:
    with site.router(turns("1h")) as router:
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE
        for routes in (SECOND.replace("TIMEOUT", "1h"), turns("1h"), SECOND.replace("TIMEOUT", "50ms")):
            assert router.total("deadman_datagrams_sent") == 0
            site.write(routes)
            assert router.reload().ok
        assert site.basestation.recv(1000) == BRAKE  # of the last command before the reloads
        wait_until(lambda: router.total("deadman_trips") == 1)
        site.write(turns("50ms"))
        assert router.reload().ok
        assert router.total("deadman_active") == 1
        site.send(DRIVE)
        while site.basestation.recv(1000) != DRIVE:
            pass
        wait_until(lambda: router.total("deadman_trips") == 2)


def test_a_deadman_that_goes_has_the_last_word_if_it_was_armed(site: Site) -> None:
    with site.router(turns("1h") + PH) as router:
        site.write(PH)
        assert router.reload().ok  # nothing to say: no command came
        site.write(turns("1h", "send") + PH)  # a reload is no start
        assert router.reload().ok
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE
        site.write(PH)
        assert router.reload().ok
        assert site.basestation.recv(1000) == BRAKE
        site.send(numbered(1))
        assert site.basestation.recv(1000) == numbered(1)
    assert router.total("deadman_datagrams_sent") == 1


def test_a_rate_is_kept_over_a_reload(site: Site) -> None:
    slow = "  ph_info: {source: sensor_board, destinations: [{endpoint: basestation, max_rate: 0.001}]}\n"
    with site.router(slow) as router:
        site.send(numbered(0))
        assert site.basestation.recv(1000) == numbered(0)
        site.write(slow + turns("1s"))
        assert router.reload().ok
        site.send(numbered(1))
        wait_until(lambda: router.total("datagrams_received") == 2)
    assert router.total("messages_dropped") == 1


def test_reloads_leave_nothing_behind(site: Site) -> None:
    sizes = []
    with site.router(PH) as router, site.under_load():
        for number in range(12):
            site.write([TOPIC + turns("1s"), PH][number % 2])
            assert router.reload().ok
            if number % 2:
                gc.collect()
                sizes.append(len(gc.get_objects()))
    assert sizes[-1] <= sizes[1] + 50
    site.take()
    assert site.received == site.sent


def test_a_changed_file_is_taken_over_where_the_table_asks_for_that(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "PERIOD", 0.1)
    path = site.write(PH)
    path.write_text("reload: {on_change: true}\n" + path.read_text())
    program = check_table(path).program
    assert program is not None
    with Router(program) as router:
        path.write_text(path.read_text() + turns("1s"))
        wait_until(lambda: len(router.program.table.routes) == 2, "the change")
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE


def test_a_reload_waits_for_files_that_are_being_written(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is there meanwhile is valid: the base that the table extends, whose routes go elsewhere."""
    with site.router(PH) as router:
        table = router.program.table.path
        table.rename(site.folder / "base.yaml")
        beginning = "version: 1\nextends: base.yaml\n"
        table.write_text(beginning)
        write_while_it_waits(monkeypatch, lambda: table.write_text(f"{beginning}routes:\n{turns('1s')}"))
        assert router.reload().text == "route manual_drive added"


def test_a_reload_waits_for_files_that_only_the_new_table_names(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    with site.router(PH) as router:
        table, base = router.program.table.path, site.folder / "base.yaml"
        beginning = table.read_text()
        table.write_text("version: 1\nextends: base.yaml\n")
        let_rest(table)
        base.write_text(beginning)
        write_while_it_waits(monkeypatch, lambda: base.write_text(beginning + turns("1s")))
        assert router.reload().text == "route manual_drive added"


def test_a_reload_refuses_files_that_do_not_come_to_rest(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reloading, "UNCHANGED_TIMEOUT", 1.0)
    with site.router(PH) as router:
        path, ended = site.write(PH + turns("1s")), threading.Event()

        def write() -> None:
            while not ended.wait(0.05):
                path.write_text(path.read_text() + "# more\n")

        writing = threading.Thread(target=write)
        writing.start()
        wait_until(lambda: path.read_text().endswith("more\n"), "the first line")
        result = router.reload()
        ended.set()
        writing.join()
        assert (result.ok, result.text) == (False, f"these files are still being written: {path}")
        assert len(router.program.table.routes) == 1
        let_rest(path)
        assert router.reload().ok


def test_a_reload_waits_for_nothing_where_files_rest(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def sleep(seconds: float) -> None:
        raise AssertionError(f"it waits for {seconds} s")

    monkeypatch.setattr(watching, "sleep", sleep)
    with site.router(PH) as router:
        os.utime(site.write(PH + turns("1s")), (time() + 60,) * 2)  # by a clock that was set back since
        assert router.reload().ok


def test_a_reload_that_moves_every_endpoint_is_warned_about(site: Site) -> None:
    with site.router(PH) as router:
        path = site.write(PH)
        text = path.read_text()
        port = site.basestation.getsockname()[1]

        def warned(*moves: tuple[str, str]) -> list[object]:
            path.write_text(functools.reduce(lambda text, move: text.replace(*move), moves, text))
            let_rest(path)
            with capture_logs() as logged:
                assert router.reload().ok
            return [line["endpoints"] for line in logged if line["log_level"] == "warning"]

        one = ("127.0.0.30:8", "127.0.0.31:8")
        two = (f"127.0.0.1:{port}", f"127.0.0.2:{port}")
        assert warned(one) == warned() == []
        assert warned(one, two) == [
            ["sensor_board 127.0.0.30:8 -> 127.0.0.31:8", f"basestation 127.0.0.1:{port} -> 127.0.0.2:{port}"]
        ]


def test_the_result_names_changed_states_services_and_envelopes(site: Site) -> None:
    def written(valid_for: str = "5s", timeout: str = "1s", because: str = "") -> None:
        path = site.write(
            f"""\
  control_mode: {{source: basestation}}
state:
  mode: {{case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL, valid_for: {valid_for}}}
services:
  measure:
    type: std_srvs/srv/Trigger
    request: {{case: rock_measure_request, to: basestation, fields: {{x1: 1}}}}
    reply: {{case: rock_measure_result, fields: {{success: length_cm > 0}}}}
    timeout: {timeout}
    on_timeout: {{message: reason}}
"""
        )
        path.write_text(path.read_text().replace("oneof: payload", f"oneof: payload{because}"))
        let_rest(path)

    pytest.importorskip("rclpy", reason="needs ROS 2")
    written()
    program = check_table(site.folder / "table.yaml").program
    assert program is not None
    with Router(program) as router:
        written(valid_for="6s")
        assert router.reload().text == "state mode changed"
        written(valid_for="6s", timeout="2s")
        assert router.reload().text == "service measure changed"
        written(valid_for="6s", timeout="2s", because=", because: a reason")
        assert router.reload().text == "envelope changed"


def test_a_gateway_keeps_its_clients_unless_it_changes_itself(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    port = free_port(kind=socket.SOCK_STREAM)
    gateway = f"  dashboard: {{transport: {{tcp: 127.0.0.1:{port}}}, publish_period: %s}}\n"
    with site.router(TOPIC) as router:
        site.write(TOPIC + "gateways:\n" + gateway % "1s")
        assert router.reload().text == "gateway dashboard added"
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.settimeout(10)
            wait_until(lambda: client_count(router) == 1, "the client")
            site.write(PH + "# a line more\ngateways:\n" + gateway % "1s")
            assert router.reload().text == "route ph_info changed"
            assert client_count(router) == 1
            site.write(PH + "gateways:\n" + gateway % "2s")
            assert router.reload().text == "gateway dashboard changed"
            while client.recv(4096):
                pass
        socket.create_connection(("127.0.0.1", port)).close()
        site.write(PH)
        assert router.reload().text == "gateway dashboard removed"
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port))


def test_a_gateway_that_made_room_in_vain_is_opened_again(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    port = free_port(kind=socket.SOCK_STREAM)
    gateways = f"gateways:\n  dashboard: {{transport: {{tcp: 127.0.0.1:{port}}}, publish_period: %s}}\n"
    with socket.create_server(("127.0.0.1", 0)) as taken, site.router(PH + gateways % "1s") as router:
        another = f"  another: {{transport: {{tcp: 127.0.0.1:{taken.getsockname()[1]}}}}}\n"
        for _ in range(2):
            site.write(PH + gateways % "2s" + another)
            assert "cannot open gateway 'another'" in router.reload().text
            with socket.create_connection(("127.0.0.1", port)):
                wait_until(lambda: client_count(router) == 1)
        site.write(PH + gateways % "2s")
        assert router.reload().text == "gateway dashboard changed"
        with socket.create_connection(("127.0.0.1", port)):
            wait_until(lambda: client_count(router) == 1)


def client_count(router: Router) -> int:
    return numbers(router).total("gateway_clients")


def test_what_a_gateway_let_in_is_stopped_when_a_reload_ends_that(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    port = free_port(kind=socket.SOCK_STREAM)
    gateway = operator(port, "1h")
    with site.router(PH + gateway) as router, socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(b'{"op": "publish", "topic": "/word", "type": "std_msgs/msg/Bool", "data": {"data": true}}\n')
        wait_until(lambda: router.total("messages_published") == 1)
        site.write(PH)
        assert router.reload().ok
        assert router.total("deadman_datagrams_sent") == 1


TRUE = b'{"op": "publish", "topic": "/word", "type": "std_msgs/msg/Bool", "data": {"data": true}}\n'


def test_a_deadman_brakes_while_the_middleware_blocks_that_of_a_gateway(
    site: Site, stuck: tuple[threading.Event, threading.Event]
) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    gateway = operator(port, "10ms")
    is_in, _ = stuck
    site.basestation.settimeout(20)
    with site.router(turns("500ms") + gateway), socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(TRUE)
        assert is_in.wait(20)
        site.send(DRIVE)
        assert [site.basestation.recv(64) for _ in range(3)] == [DRIVE, BRAKE, BRAKE]


def test_neither_clients_nor_a_reload_wait_for_the_deadman_of_a_gateway_that_is_stuck(
    site: Site, stuck: tuple[threading.Event, threading.Event]
) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    is_in, goes_on = stuck
    with (
        capture_logs() as logged,
        site.router(PH + operator(port, "10ms")) as router,
        socket.create_connection(("127.0.0.1", port)) as client,
    ):
        client.sendall(TRUE)
        assert is_in.wait(20)
        wait_until(lambda: router.total("deadman_active") == 1)
        site.write(PH + operator(port, "1h"))
        assert router.reload().ok
        assert [entry["threads"] for entry in logged if "stay open" in entry["event"]] == [["client deadmen"]]
        with socket.create_connection(("127.0.0.1", port)) as another:
            another.sendall(TRUE)
            wait_until(lambda: router.total("messages_published") == 2)
            wait_until(lambda: router.total("deadman_active") == 0)
        goes_on.set()
        assert router.reload().ok
        assert (router.total("deadman_trips"), router.total("deadman_datagrams_sent")) == (1, 1)
    assert router.total("deadman_datagrams_sent") == 2  # at the stop, as a client had published


def test_a_stop_leaves_the_deadman_of_a_gateway_that_is_stuck(
    site: Site, stuck: tuple[threading.Event, threading.Event]
) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    is_in, _ = stuck
    with (
        capture_logs() as logged,
        site.router(turns("1h") + operator(port, "10ms")),
        socket.create_connection(("127.0.0.1", port)) as client,
    ):
        site.send(DRIVE)
        assert site.basestation.recv(64) == DRIVE
        client.sendall(TRUE)
        assert is_in.wait(20)
    assert site.basestation.recv(64) == BRAKE
    left = [entry["threads"] for entry in logged if "the router exits without it" in entry["event"]]
    assert left == [["client deadmen"]]


@pytest.mark.parametrize("late", ["settle", "replaced"])
def test_what_fails_when_the_table_runs_already_is_not_told_as_if_nothing_had_changed(
    site: Site, monkeypatch: pytest.MonkeyPatch, late: str
) -> None:
    """Neither a failure of what follows the adoption, nor one of who is told of it."""

    def fail(*_: object) -> None:
        raise LookupError("a bug")

    with capture_logs() as logged, site.router(PH) as router:
        site.write(PH + turns("1h"))
        if late == "settle":
            monkeypatch.setattr("router.app.counts.Counters.settle", fail)
        else:
            monkeypatch.setattr(router._reloader, "_replaced", fail)
        assert router.reload() == (True, ANY, "route manual_drive added")
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE
    told = [entry["event"] for entry in logged if entry["log_level"] == "critical"]
    assert [event.split(";")[-1] for event in told] == [" please report it"]


def test_files_that_go_while_they_are_read_change_nothing(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def vanished(*_: object) -> None:
        raise FileNotFoundError(2, "No such file or directory", "components")

    with site.router(PH) as router:
        monkeypatch.setattr("router.app.reloading.check_table", vanished)
        result = router.reload()
        assert (result.ok, "components" in result.text) == (False, True)
        assert reloads(router, "failed") == 1
        site.send(numbered(1))
        assert site.basestation.recv(1000) == numbered(1)


def test_a_service_manager_hears_of_no_reload_before_the_start_or_after_the_end(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    with site.router(PH) as router:
        pass
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hearing:
        hearing.bind(str(site.folder / "notify"))
        hearing.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(site.folder / "notify"))
        assert router.reload().text == "the router is not running"
        with pytest.raises(BlockingIOError):
            hearing.recv(1000)


@pytest.mark.parametrize("has_topics", [True, False])
def test_a_reload_frees_what_only_the_first_table_had(site: Site, has_topics: bool) -> None:
    """Its image and its deadmen, for example."""
    if has_topics:
        pytest.importorskip("rclpy", reason="needs ROS 2")
    gateways = f"gateways:\n  it: {{transport: {{tcp: 127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}}}}}\n"
    routes = (TOPIC if has_topics else PH) + turns("1h")
    with site.router(routes + gateways * has_topics) as router:
        image = router._runtime.plane.image
        assert image
        first, deadman = weakref.ref(image), weakref.ref(image.deadmen["manual_drive"])
        del image
        site.write(routes.replace("1h", "2h") + gateways * has_topics)
        assert router.reload().ok
        gc.collect()
        assert (first(), deadman()) == (None, None)


def adoption_of(counters: Counters) -> Change:
    return Change(cast("CompiledTable", SimpleNamespace(counters=counters)), None, is_first=False)


def test_what_a_program_counted_that_was_abandoned_is_nobodys() -> None:
    counts = ThreadCounts(Counters())
    abandoned = counts.counters.continued()
    index = abandoned.index("datagrams_padded", "another")
    counts.prepare(adoption_of(abandoned))
    counts.gateways[index] += 1
    then = counts.counters.continued()
    assert then.index("datagrams_received", "rover") == index
    for step in (counts.prepare, counts.adopt, counts.finish):
        step(adoption_of(then))
    assert counts.total("datagrams_received") == 0


@pytest.mark.slow
def test_a_gateway_in_a_zenoh_network_goes_on_unless_its_config_changes(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    settings = f"{{key: rovers/one, listen: [tcp/127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}], config: zenoh.json5}}"
    gateways = f"gateways:\n  %s: {{transport: {{zenoh: {settings}}}}}\n"
    config = site.folder / "zenoh.json5"
    config.write_text("{queries_default_timeout: 1000}")
    with site.router(PH + gateways % "earth") as router:
        assert config in watched_files(router.program.table)
        site.write(PH + "# a line more\n" + gateways % "earth")
        assert router.reload().text == "nothing changed"
        config.write_text("{queries_default_timeout: 2000}")
        assert router.reload().text == "gateway earth changed"
        config.write_text("{queries_default_timeout: soon}")
        assert router.reload().text == "the table has 1 error"
        config.write_text("{queries_default_timeout: 2000}")
        site.write(PH + gateways % "mars")
        assert router.reload().text == "gateway earth removed, gateway mars added"
        wait_until(lambda: client_count(router) == 1, "its turn")
        assert set(numbers(router).counts("gateway_key_conflicts").values()) == {0}


def test_a_reload_agrees_with_validate_about_stray_protos_and_a_lock_elsewhere(site: Site) -> None:
    protos, lock = site.folder / "protos", site.folder / "wire.lock.json"
    shutil.copytree(PROTOS, protos)
    (protos / "envelope.lock.json").rename(lock)
    own = f"envelope: {{protos: protos, message: PBEnvelope, oneof: payload, lock: {lock.name}}}"

    def write(routes: str) -> None:
        path = site.write(routes)
        path.write_text(re.sub("envelope:.*", own, path.read_text()))
        let_rest(path)

    with site.router(PH) as router:
        write(PH)
        assert router.reload().ok
        assert lock in watched_files(router.program.table)
        (protos / "stray.proto").write_text("<<<<<<< HEAD\n")
        assert router.reload().ok
        text = lock.read_text()
        lock.write_text(text.replace("float ph_value", "double ph_value"))
        assert router.reload().text == "the table has 1 error"
        lock.write_text(text)
        assert router.reload().ok
        (protos / "stray.proto").unlink()
        lock.unlink()
        assert router.reload().text == "the table has 1 error"
        site.send(numbered(1))
        assert site.basestation.recv(1000) == numbered(1)
