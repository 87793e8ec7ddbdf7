"""A whole router in this process: real tables, real sockets, and ROS subscribers in processes of their own."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from structlog.testing import capture_logs

from router import threads
from router.app import Router
from router.app.gateways import Gateways
from router.app.image_saver import ImageSaver
from router.app.plane import Plane
from router.app.runtime import Runtime
from router.carrier.forwarding_threads import ForwardingThreads
from router.carrier.publishing import PublishThread
from router.compiler.metrics import REJECT_REASONS
from router.declared import MAX_DATAGRAM
from router.errors import StartError
from router.inputs import Inputs
from router.observe.http import HttpServer
from router.observe.snapshot import snapshot
from router.recording.mirror import Mirrored
from router.recording.recorder import Recorder, RecordError
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, Site, let_rest, numbered, udp
from tests.ports import free_port
from tests.recording.recorder_rig import read

ROOT = Path(__file__).parents[2]
PH = bytes.fromhex("0a11 0d713dda40 1560e52040 1d33334541 2001".replace(" ", ""))  # 6.82, 2.51, 12.3, operating
NAN_PH = bytes.fromhex("0a05 0d0000c07f".replace(" ", ""))

ROUTE = """\
  ph_info:
    source: sensor_board
    destinations: [basestation]
"""
TURNS = """\
  manual_drive:
    source: sensor_board
    destinations: [basestation]
    deadman:
      {timeout: 20ms, send: {manual_brake: {brake: true}}, to: [basestation], repeat: 10ms, disarmed_by: [ph_info]}
"""
TOPIC = """\
    topics:
      - {topic: ph, type: comms/msg/SensorBoardPHInfo, queue_depth: 10, fields: auto}
"""


def test_a_message_reaches_the_topic_and_every_step_is_counted(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.peers import Subscriber

    program = site.program(ROUTE + TOPIC)
    with Router(program) as router, closing(Subscriber("ph", "comms/msg/SensorBoardPHInfo")) as subscriber:
        assert subscriber.line() == "matched"
        while not router.totals()["messages_published"]:  # the router learns of the subscriber when it does
            site.send(PH)
            assert site.basestation.recv(1000) == PH
        cdr = bytes.fromhex(subscriber.line())
    assert struct.unpack_from("<fffBB", cdr, 4) == pytest.approx((6.82, 2.514, 12.325, 1, 0), abs=0.001)
    accepted, filtered = router.total("messages_received"), router.total("messages_filtered")
    published = router.total("messages_published")
    assert router.totals() == {
        "datagrams_received": accepted,
        "datagrams_rejected": 0,
        "messages_received": accepted,
        "datagrams_sent": accepted,
        "messages_published": published,
        "messages_dropped": 0,
        "kernel_drops": 0,
    }
    assert published >= 1
    assert published + filtered == accepted


def test_what_has_arrived_is_routed_before_the_router_stops(site: Site) -> None:
    with Router(site.program(ROUTE)) as router:
        site.send(*[PH] * 100)
    assert router.totals()["datagrams_sent"] == 100
    assert [site.basestation.recv(1000) for _ in range(100)] == [PH] * 100


def test_who_takes_over_silences_the_deadman_of_who_has_stopped(site: Site) -> None:
    with capture_logs() as logged, Router(site.program(ROUTE + TURNS)) as router:
        assert site.basestation.recv(1000) == BRAKE  # since the router starts
        site.send(DRIVE)
        assert site.basestation.recv(1000) == DRIVE
        assert site.basestation.recv(1000) == BRAKE
        site.send(PH)
        while (received := site.basestation.recv(1000)) != PH:
            assert received == BRAKE
        time.sleep(0.1)  # ten repeats, had it gone on
        site.send(PH)
        assert site.basestation.recv(1000) == PH
        assert (router.total("deadman_active"), router.total("deadman_trips")) == (0, 1)
    told = [entry["event"] for entry in logged if entry.get("route") == "manual_drive"]
    assert told == [
        "the deadman has sent its payload at startup",
        "no commands arrive; the deadman sends in their place",
        "commands arrive again; the deadman has stopped sending",
    ]


TWO_BOARDS = """\
  manual_drive:
    source: sensor_board
    destinations: [first, {endpoint: second, max_rate: 4 Hz, on_limit: latest}]
    ttl: 300ms
    deadman: {timeout: 300ms, send: {manual_drive: {turn: 1}, manual_brake: {brake: true}}, at_start: silent,
              disarmed_by: ph_info}
  ph_info: {source: sensor_board, destinations: second, deadman: {none: for tests}}
"""


def test_who_takes_over_one_board_leaves_the_other_its_brake_and_gets_no_older_command(site: Site) -> None:
    with udp("127.0.0.1") as first, udp("127.0.0.1") as second:
        addresses = {"first": first.getsockname()[1], "second": second.getsockname()[1]}
        endpoints = "".join(
            f'  {name}: {{address: "127.0.0.1:{port}", kind: tool}}\n' for name, port in addresses.items()
        )
        with Router(site.program(TWO_BOARDS, endpoints)) as router:
            site.send(DRIVE, DRIVE, numbered(1))  # the second board is to get its second command later
            assert [first.recv(1000) for _ in range(4)] == [DRIVE, DRIVE, bytes.fromhex("c201021002"), BRAKE]
            wait_until(lambda: router.total("deadman_datagrams_sent") >= 4)
            assert router.total("deadman_trips") == 1
            site.send(numbered(2))
            assert [second.recv(1000) for _ in range(3)] == [DRIVE, numbered(1), numbered(2)]
            assert router.total("messages_dropped") == 1
        second.setblocking(False)
        with pytest.raises(BlockingIOError):
            second.recv(1000)


def test_what_a_deadman_sends_is_trimmed_for_who_asks_for_it(site: Site) -> None:
    port = site.basestation.getsockname()[1]
    trims = f'  old: {{address: "127.0.0.1:{port}", kind: tool, trim_trailing_zeros: true}}\n'
    empty = "    deadman: {timeout: 1s, send: {manual_arm: {}}, to: [old]}\n"
    with Router(site.program(TURNS.partition("    deadman:")[0] + empty, trims)):
        assert site.basestation.recv(1000) == bytes.fromhex("d201")


def test_a_last_word_waits_for_no_recorder_which_still_gets_all_that_came(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[bytes] = []
    close = Recorder.close

    def close_late(recorder: Recorder) -> None:
        said.extend(site.basestation.recv(1000) for _ in range(102))
        close(recorder)

    monkeypatch.setattr(Recorder, "close", close_late)
    with Router(site.program(ROUTE + TURNS.replace("20ms", "1h") + "record: {directory: recordings}\n")):
        site.send(*[DRIVE] * 100)
    assert said == [BRAKE, *[DRIVE] * 100, BRAKE]
    [recording] = (site.folder / "recordings").iterdir()
    assert [each.data for each in read(recording)] == [DRIVE] * 100


def test_what_comes_before_the_recorder_is_open_is_recorded(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = Recorder.__init__

    def open_late(*arguments: Any) -> None:
        site.send(PH)
        assert site.basestation.recv(1000) == PH
        opened(*arguments)

    monkeypatch.setattr(Recorder, "__init__", open_late)
    with Router(site.program(ROUTE + "record: {directory: recordings}\n")):
        pass
    [recording] = (site.folder / "recordings").iterdir()
    assert [each.data for each in read(recording)] == [PH]


GATEWAY = TOPIC + 'gateways: {dashboard: {transport: {websocket: "127.0.0.1:PORT"}}}\n'


@pytest.mark.parametrize("has_gateway", [False, True])
def test_it_forwards_before_gateways_and_pages_are_open(
    site: Site, monkeypatch: pytest.MonkeyPatch, has_gateway: bool
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from router.gateway.thread import GatewayThread

    forwarded: list[str] = []

    def forward_before(kind: type, method: str) -> None:
        original = getattr(kind, method)

        def forward(*arguments: Any) -> Any:
            site.send(PH)
            assert site.basestation.recv(1000) == PH
            forwarded.append(kind.__name__)
            return original(*arguments)

        monkeypatch.setattr(kind, method, forward)

    forward_before(GatewayThread, "prepare")
    forward_before(HttpServer, "__init__")
    http = f'http: {{address: "127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"}}\n'
    gateway = GATEWAY.replace("PORT", str(free_port(kind=socket.SOCK_STREAM))) if has_gateway else ""
    with Router(site.program(ROUTE + gateway + http)):
        assert forwarded == ["GatewayThread", "HttpServer"][not has_gateway :]


def test_a_gateway_that_cannot_be_opened_is_told_with_its_line_and_leaves_nothing_open(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        program = site.program(ROUTE + GATEWAY.replace("PORT", str(taken.getsockname()[1])))
        with pytest.raises(StartError, match=r"table.yaml:14:\d+"), Router(program):
            pass
    with Router(program):  # the listener's port is free again
        pass


def test_who_asks_for_a_recording_does_not_wait_for_the_disk(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, saved = threading.Event(), SimpleQueue[str]()

    def save(_: Recorder, reason: str) -> None:
        saved.put(reason)
        assert go_on.wait(10)
        raise RecordError("the disk is full")

    monkeypatch.setattr(Recorder, "save", save)
    with (
        capture_logs() as logged,
        Router(site.program(ROUTE + "record: {directory: recordings, last: 60s}\n")) as router,
    ):
        router.save_recording("first")
        assert saved.get(timeout=10) == "first"
        for reason in ("second", "third"):  # which the second one saves, as it has not begun
            router.save_recording(reason)
        go_on.set()
        assert saved.get(timeout=10) == "second"
        wait_until(lambda: [entry.get("problem") for entry in logged].count("the disk is full") == 2)
    assert saved.empty()


class NoThread:
    """A thread for which there is no memory."""

    def __init__(self, *_: object) -> None: ...

    def start(self) -> None:
        raise RuntimeError("can't start new thread")


def test_a_recording_for_which_there_is_no_thread_ends_nothing(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        capture_logs() as logged,
        Router(site.program(ROUTE + "record: {directory: recordings, last: 60s}\n")) as router,
    ):
        with monkeypatch.context() as short:
            short.setattr(threads, "Thread", NoThread)
            router.save_recording("signal")
        assert [entry["problem"] for entry in logged if "cannot save" in entry["event"]] == ["can't start new thread"]
        router.save_recording("signal")
        wait_until(lambda: "saved the last datagrams" in [entry["event"] for entry in logged])


def test_a_program_for_which_there_is_no_thread_is_not_kept_and_ends_nothing(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    saver = ImageSaver(Inputs(), Inputs(), None)
    monkeypatch.setattr(threads, "Thread", NoThread)
    with capture_logs() as logged, Router(site.program(ROUTE), saver=saver) as router:
        assert router.reload().ok
    why = [(entry["log_level"], entry["why"]) for entry in logged if "is not kept" in entry["event"]]
    assert why == [("warning", "can't start new thread")]


def test_who_begins_to_watch_while_the_router_starts_sees_all(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    router = Router(site.program(ROUTE))
    seen: list[bytes] = []
    adopt = Plane.adopt

    def adopt_late(plane: Plane, *change: Any) -> None:
        router.mirror.attach(lambda batch: seen.extend(data for *_, data in batch))
        adopt(plane, *change)

    monkeypatch.setattr(Plane, "adopt", adopt_late)
    with router:
        site.send(PH)
        assert site.basestation.recv(1000) == PH
    assert seen == [PH]


def test_who_watches_is_told_what_was_decided_about_each_datagram_in_the_order_of_arrival(site: Site) -> None:
    routes = f"{ROUTE}  imu_info: {{ignore: nobody wants it}}\n"
    sent = {
        PH: "",
        PH + bytes(3): "",
        bytes(MAX_DATAGRAM + 100): "truncated",
        b"": "empty",
        b"\x0f": "malformed",  # a field without a wire type
        bytes(4): "no_payload",
        bytes.fromhex("a20600"): "unknown_case",
        bytes.fromhex("6200"): "unhandled",  # gps_info
        bytes.fromhex("6a00"): "ignored",  # imu_info
    }
    seen: list[Mirrored] = []
    with udp("127.0.0.9") as stranger, site.router(routes) as router:
        router.mirror.attach(seen.extend)
        for data in sent:
            site.send(data)
        stranger.sendto(PH, ("127.0.0.1", site.listen))
        wait_until(lambda: router.total("datagrams_received") == len(sent) + 1)
        counted = snapshot(router.collect(), 0).counts("datagrams_rejected")
    assert [(host, *rest) for _, _, (host, _), *rest in seen] == [
        *(("127.0.0.30", "sensor_board", reason, data[: MAX_DATAGRAM + 1]) for data, reason in sent.items()),
        ("127.0.0.9", "", "source_mismatch", PH),
    ]
    of_links = {"bad_frame", "bad_checksum"}
    assert counted == {("rover", reason): int(reason not in of_links) for reason in REJECT_REASONS}


def test_a_scrape_reads_what_was_published_before_what_was_received(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else what is received and published in between would be published without having waited."""
    read: list[str] = []

    def noted(kind: type[ForwardingThreads | PublishThread]) -> None:
        original = kind.counters

        def note(of: Any, size: int) -> Any:
            read.append(kind.__name__)
            return original(of, size)

        monkeypatch.setattr(kind, "counters", note)

    noted(ForwardingThreads)
    noted(PublishThread)
    with Router(site.program(ROUTE)) as router:
        list(router.collect())
    assert read == ["PublishThread", "ForwardingThreads"]


def test_metrics_are_served_before_what_an_earlier_table_used_is_closed(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread that is stuck in the middleware delays that."""
    scraped: list[set[str]] = []
    with Router(site.program(ROUTE)) as router:
        passed = router._runtime.plane.wait_until_adopted

        def scrape() -> bool:
            scraped.append({sample.labels.get("route", "") for family in router.collect() for sample in family.samples})
            return passed()

        monkeypatch.setattr(router._runtime.plane, "wait_until_adopted", scrape)
        site.program(ROUTE + TURNS)
        let_rest(router.program.table.path)
        assert router.reload().ok
    assert [routes >= {"ph_info", "manual_drive"} for routes in scraped] == [True]


def test_metrics_are_served_while_it_runs(site: Site) -> None:
    address = f"127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
    with Router(site.program(ROUTE + f'http: {{address: "{address}"}}\n')) as router:
        site.send(PH, b"\x00\x01")
        assert site.basestation.recv(1000) == PH
        while router.totals()["datagrams_received"] < 2:
            pass
        text = urllib.request.urlopen(f"http://{address}/metrics", timeout=10).read().decode()
    samples = {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert samples["router_datagrams_received_total", "rover"] == 2
    assert samples["router_datagrams_sent_total", "basestation", "ph_info"] == 1
    assert samples["router_messages_dropped_total", "basestation", "false", "ph_info", "send_error"] == 0
    [build] = [labels for name, *labels in samples if name == "router_build_info"]
    assert router.program.table.sha256 in build
    assert router.program.protos_sha256 in build
    assert "compiled" in build


def test_metrics_tell_on_which_topics_a_publisher_is_stuck(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    others = "      - {topic: other, type: comms/msg/SensorBoardPHInfo, fields: auto}\n"
    with Router(site.program(ROUTE + TOPIC + others)) as router:
        runtime = router._runtime

        def stalled() -> dict[str, float]:
            families = {family.name: family for family in router.collect()}
            samples = families["router_publish_stalled_seconds"].samples
            return {sample.labels["topic"]: sample.value for sample in samples}

        assert stalled() == {"ph": 0, "other": 0}
        monkeypatch.setattr(runtime.plane, "stalled", lambda: iter([("ph", 2.5)]))
        monkeypatch.setattr(runtime.topics.node, "stalled", lambda: iter([("ph", 1.5), ("other", 0.009)]))
        assert stalled() == {"ph": 2.5, "other": 0}


def test_metrics_tell_where_the_native_thread_is_stuck_while_forwarding_goes_on(
    site: Site, stuck: tuple[threading.Event, threading.Event]
) -> None:
    _, goes_on = stuck
    wanted = TOPIC.replace("queue_depth: 10", "qos: {durability: transient_local}")
    with Router(site.program(ROUTE + wanted)) as router:

        def stalled() -> float:
            return router._runtime.stalled()["ph"]

        site.send(PH)
        wait_until(lambda: stalled() >= 0.01)
        site.send(PH)
        assert [site.basestation.recv(1000) for _ in range(2)] == [PH, PH]
        before = stalled()
        wait_until(lambda: stalled() > before)
        goes_on.set()
        wait_until(lambda: stalled() == 0)
    assert router.totals()["messages_published"] == 2


def test_a_failing_mapping_is_told_once_with_the_line_of_the_table(site: Site) -> None:
    failing = """\
    topics:
      - topic: ph
        type: comms/msg/SensorState
        qos: {durability: transient_local}
        fields:
          state: clamp(round(ph_value), 0, 255)
"""
    program = site.program(ROUTE + failing)
    with capture_logs() as logged, Router(program) as router:
        site.send(NAN_PH, NAN_PH, NAN_PH)
    lines = [entry for entry in logged if entry["event"] == "message dropped"]
    assert [(line["reason"], line.get("more")) for line in lines] == [("non_finite", None), ("non_finite", 2)]
    assert lines[0]["detail"] == f"{program.table.path}:17:18: state: nan is not an integer"
    assert router.totals()["datagrams_sent"] == router.totals()["messages_dropped"] == 3


def test_the_place_of_a_condition_that_fails_is_told_and_none_of_another_program(site: Site) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    failing = """\
    topics:
      - topic: ph
        type: std_msgs/msg/Float32
        qos: {durability: transient_local}
        when: 1 / temperature > 0
        fields: {data: ph_value}
"""
    with capture_logs() as logged, Router(site.program(ROUTE + failing)) as router:
        plane = router._runtime.plane
        site.send(NAN_PH)
        wait_until(lambda: router.totals()["messages_dropped"] == 1)
        generation = plane.now.image.generation if plane.now else 0
        told = [plane._where_refused("ph_info", None, "ph", each, 1) for each in (generation, generation + 1)]
    place = f"{router.program.table.path}:16:15: when"
    assert told == [place, ""]
    lines = [entry for entry in logged if entry["event"] == "message dropped"]
    assert [(line["reason"], line["detail"]) for line in lines] == [("mapping_error", f"{place}: division by zero")]


def test_the_place_of_a_condition_of_a_destination_is_told(site: Site) -> None:
    table = ROUTE.replace(
        "destinations: [basestation]", "destinations: [{endpoint: basestation, when: 1 / temperature > 0}]"
    )
    with capture_logs() as logged, Router(site.program(table)) as router:
        site.send(NAN_PH)
        wait_until(lambda: router.totals()["messages_dropped"] == 1)
    (line,) = [entry for entry in logged if entry["event"] == "message dropped"]
    assert (line["reason"], line["target"]) == ("mapping_error", "basestation")
    assert str(line["detail"]).endswith(": when: division by zero")


def test_start_and_stop_are_logged_with_what_runs_and_what_was_done(site: Site) -> None:
    with capture_logs() as logged, Router(site.program(ROUTE)):
        pass
    started, stopping, stopped = logged
    assert started["event"] == "router started"
    assert started["listening"] == {"rover": f"127.0.0.1:{site.listen}"}
    assert (started["routes"], started["destinations"]) == (1, 1)
    assert (started["published"], started["subscribed"]) == (0, 0)
    assert stopping["event"] == "router stopping"
    assert (stopped["event"], stopped["datagrams_received"]) == ("router stopped", 0)


def test_what_cannot_be_opened_is_told_with_its_line_and_leaves_nothing_open(site: Site) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        program = site.program(ROUTE + f'http: {{address: "127.0.0.1:{taken.getsockname()[1]}"}}\n')
        with pytest.raises(StartError, match=r"table.yaml:12:\d+: cannot serve HTTP"), Router(program):
            pass
    with Router(program):  # the listener's port is free again
        pass


def test_a_table_without_topics_runs_without_ros(site: Site) -> None:
    path = site.program(ROUTE).table.path
    script = (
        "import sys; from pathlib import Path\n"
        "from router.compiler import check_table; from router.app import Router\n"
        f"with Router(check_table(Path({str(path)!r})).program): sys.exit('rclpy' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


@pytest.mark.parametrize(
    ("owner", "place"),
    [(Runtime, "_stop_plane"), (Gateways, "close"), (Runtime, "_end_client_deadmen"), (Runtime, "_stop_ros")],
)
def test_whatever_is_stuck_at_the_stop_the_brake_is_sent(
    site: Site, monkeypatch: pytest.MonkeyPatch, owner: type, place: str
) -> None:
    goes_on, has_ended = threading.Event(), threading.Event()
    stop = getattr(owner, place)

    def stuck(stopped: object) -> None:
        goes_on.wait()
        stop(stopped)
        has_ended.set()

    monkeypatch.setattr(threads, "STEP_S", 0.1)
    monkeypatch.setattr(owner, place, stuck)
    monkeypatch.setattr(HttpServer, "close", lambda _: goes_on.wait())
    more = f"http: {{address: 127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}}}\n"
    with capture_logs() as logs:
        with Router(site.program(ROUTE + TURNS.replace("20ms", "20s"), more)) as router:
            assert site.basestation.recv(1000) == BRAKE  # of the start
            site.send(DRIVE)
            assert site.basestation.recv(1000) == DRIVE
        assert site.basestation.recv(1000) == BRAKE
    left = [each["step"] for each in logs if each["event"] == "shutdown step did not finish in time; continuing"]
    assert {each.rpartition(".")[2] for each in left} >= {"stuck", "<lambda>"}  # a busy computer may delay other steps
    # What is opened next must not get the descriptor of a thread that still receives.
    assert (router.listeners["rover"].socket.fileno() >= 0) == (place == "_stop_plane")
    goes_on.set()
    assert has_ended.wait(10)
    router.listeners["rover"].close()
