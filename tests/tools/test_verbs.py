"""The verbs send, listen and sim as they are typed."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from geometry_msgs.msg import Point
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from router.cli import main
from router.table import read_table
from tests.compiler.payloads import wire_of
from tests.ports import free_port
from tests.rehearsal.test_tables import TABLES
from tests.tools.conftest import place

EMPTY_PLAIN = bytes.fromhex("1200")


def test_send_says_what_it_sent_once_or_at_a_rate_trimmed_or_padded(
    receiver: socket.socket, protos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = place(receiver)
    for words, sent, says in (
        (["value=1.5"], ["12050d0000c03f"], f"sent plain to {to}: 7 bytes 12050d0000c03f\n"),
        (["--rate", "500Hz", "--count", "4"], ["1200"] * 4, f"sent plain to {to} 4 times in "),
        (["--trim"], ["12"], f"sent plain to {to}: 1 bytes 12\n"),
        (["--pad", "5"], ["1200000000"], f"sent plain to {to}: 5 bytes 1200000000\n"),
    ):
        assert main(["send", "plain", *words, "--to", to, "--protos", str(protos)]) == 0
        assert [receiver.recv(100).hex() for _ in sent] == sent
        assert capsys.readouterr().out.startswith(says)


@pytest.mark.parametrize(("form", "sender"), [("127.0.0.1:{}", "127.0.0.1:{}"), ("[0::1]:{}", "[::1]:{}")])
def test_listen_prints_what_send_sends(protos: Path, form: str, sender: str) -> None:
    to, origin = free_port("::1"), free_port("::1")
    command = [sys.executable, "-m", "router", "listen", f"envelope://{form.format(to)}", "--count", "1"]
    command += ["--protos", str(protos)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tap:
        assert tap.stdout is not None
        assert tap.stderr is not None
        assert tap.stderr.readline() == f"listening on {sender.format(to)}; press Ctrl-C to stop\n"
        words = ["--to", form.format(to), "--from", form.format(origin), "--protos", str(protos)]
        assert main(["send", "plain", *words]) == 0
        assert tap.stdout.read().split(" ", 1)[1] == f"{sender.format(origin)} plain (all default)\n"


def test_send_from_another_family_is_refused(protos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--to", "[::1]:9", "--from", "127.0.0.1", "--protos", str(protos)]
    assert main(["send", "plain", *words]) == 2
    assert capsys.readouterr().err.endswith("help: give --from an IPv6 address\n")


def test_send_fills_fields_beside_the_payload(receiver: socket.socket, capsys: pytest.CaptureFixture[str]) -> None:
    table, frame = str(TABLES / "beside.yaml"), wire_of(TABLES / "beside", "Frame")[1].message_class
    words = ["envelope.header.seq=5", "value=1.5", "envelope.mode=AUTONOMOUS"]
    assert main(["send", "speed", *words, "--to", place(receiver), "--table", table]) == 0
    assert receiver.recv(100) == frame(header={"seq": 5}, speed={"value": 1.5}, mode=1).SerializeToString()
    assert main(["send", "labelled", "envelope=7", "--to", place(receiver), "--table", table]) == 0
    assert receiver.recv(100) == frame(labelled={"envelope": 7}).SerializeToString()
    assert main(["send", "speed", "envelope.speed=1", "--to", place(receiver), "--table", table]) == 2
    assert "Frame has no field 'speed'" in capsys.readouterr().err


def test_send_goes_from_endpoint_to_listener_and_says_when_the_router_will_not_take_it(
    table_path: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = table_path()
    words = ["send", "plain", "--table", str(path), "--to", "rover"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as router:
        router.bind(("127.0.0.1", read_table(path).listeners["rover"].address.value.port))
        router.settimeout(5)
        assert main([*words, "--from", "station"]) == 0
        data, peer = router.recvfrom(100)
        assert (data, peer[0], capsys.readouterr().err) == (EMPTY_PLAIN, "127.0.6.10", "")
        assert main(words) == 0
        assert "the table accepts plain only from station\nhelp: add --from station" in capsys.readouterr().err


def test_listen_prints_the_envelopes_that_arrive(table_path: Callable[..., Path]) -> None:
    path = table_path()
    station = read_table(path).endpoints["station"].address.value
    command = [sys.executable, "-m", "router", "listen", "envelope://station", "-t", str(path), "--count", "1"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tap,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board,
    ):
        board.bind(("127.0.6.30", 0))
        assert tap.stdout is not None
        assert tap.stderr is not None
        assert tap.stderr.readline() == f"listening on {station}; press Ctrl-C to stop\n"
        board.sendto(EMPTY_PLAIN, station)
        assert tap.stdout.read().split(" ", 1)[1] == "board plain (all default)\n"
    assert tap.returncode == 0


@contextmanager
def publishing(*messages: Point) -> Iterator[None]:
    """A publisher of `tap_test`, whose messages reach late subscribers as well."""
    context = Context()
    context.init()
    node = Node("tap_test_publisher", context=context)
    qos = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(Point, "tap_test", qos)
    for message in messages:
        publisher.publish(message)
    yield
    node.destroy_node()
    context.shutdown()


def test_listen_waits_for_a_topic_and_prints_what_it_carries() -> None:
    command = [sys.executable, "-m", "router", "listen", "topic://tap_test", "--count", "2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tap:
        assert tap.stderr is not None
        assert tap.stderr.readline() == "waiting for a publisher of tap_test; press Ctrl-C to stop\n"
        with publishing(Point(x=1.5), Point(z=-2.0)):
            out, err = tap.communicate(timeout=60)
    assert err == "listening to tap_test of geometry_msgs/msg/Point; press Ctrl-C to stop\n"
    assert [line.split(" ", 1)[1] for line in out.splitlines()] == [
        "geometry_msgs/msg/Point x=1.5",
        "geometry_msgs/msg/Point z=-2.0",
    ]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_listen_that_waits_for_a_topic_ends_with_a_signal(number: signal.Signals) -> None:
    command = [sys.executable, "-m", "router", "listen", "topic://nobody_publishes_this"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tap:
        assert tap.stderr is not None
        assert tap.stderr.readline() == "waiting for a publisher of nobody_publishes_this; press Ctrl-C to stop\n"
        tap.send_signal(number)
        out, err = tap.communicate()
    assert (tap.returncode, out, err) == (0, "", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_send_that_is_ended_by_a_signal_says_what_was_sent(number: signal.Signals, protos: Path) -> None:
    words = ["plain", "--rate", "50Hz", "--protos", str(protos)]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60)
        to = f"127.0.0.1:{receiver.getsockname()[1]}"
        command = [sys.executable, "-m", "router", "send", *words, "--to", to]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as sending:
            receiver.recv(100)
            receiver.recv(100)
            sending.send_signal(number)
            out, _ = sending.communicate(timeout=60)
    assert (sending.returncode, out.startswith(f"sent plain to {to}")) == (0, True)


def test_listening_to_a_topic_without_ros_says_what_is_missing() -> None:
    program = (
        "import sys; from router.cli import main; sys.modules['rclpy'] = None; sys.exit(main(['listen', 'topic://t']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("router listen: a topic needs ROS 2, which is not installed here (")


def test_sim_ends_on_a_signal_with_its_final_statistics(table_path: Callable[..., Path]) -> None:
    command = [sys.executable, "-m", "router", "sim", "-t", str(table_path()), "--json", "--speed", "50x"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as sim:
        assert sim.stdout is not None
        first = json.loads(sim.stdout.readline())
        sim.terminate()
        *_, last = map(json.loads, sim.stdout)
    assert (sim.returncode, first["final"], last["final"]) == (0, False, True)
    assert {endpoint: [*cases] for endpoint, cases in last["sent"].items()} == {
        "board": ["every_kind"],
        "station": ["plain"],
    }


def test_sim_writes_lines_where_there_is_no_terminal(
    table_path: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    assert main(["sim", "-t", str(table_path()), "--for", "100ms"]) == 0
    title, last = capsys.readouterr().out.splitlines()
    assert title.startswith("2 endpoints send 2 payload cases, 4/s, to 127.0.0.1:")
    assert "received 0" in last
    for number, handler in before.items():
        signal.signal(number, handler)


def test_sim_tells_when_a_board_stops_and_what_it_cannot_read(table_path: Callable[..., Path]) -> None:
    path = table_path()
    board = read_table(path).endpoints["board"].address.value
    command = [sys.executable, "-m", "router", "sim", "-t", str(path)]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as sim,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as router,
    ):
        assert sim.stdout is not None
        sim.stdout.readline()
        for data in (EMPTY_PLAIN, b"\xff"):
            router.sendto(data, board)
        obeyed, stopped = sim.stdout.readline(), sim.stdout.readline()
        sim.send_signal(signal.SIGINT)
        last = sim.stdout.read()
    assert obeyed.endswith(" s: board obeys commands\n")
    assert re.search(r" s: board no commands for [1-9]\d*\.\d s: stopped\n$", stopped)
    assert "received 1, undecodable 1" in last
