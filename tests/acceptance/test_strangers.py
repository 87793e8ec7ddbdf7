"""What an operator sees while a stranger, from an address of its own, sends the board's telemetry: the board's."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections import Counter
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from google.protobuf.message import Message
from mcap.reader import make_reader

from router.datagrams import wire_of_protos
from router.recording.reader import Recording
from router.tools.doctor import examine
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.site import ROOT, ROVER, RouterProcess, Site, site, total, udp, wait_until
from tests.observe.foxglove_client import FoxgloveClient
from tests.ports import free_port
from tests.tables import PROTOS

FORGED = 66.0
"""Degrees of latitude; the board is elsewhere."""

ROUNDS, TIMES = 20, 20
"""The stranger sends so many times as often as the board."""

MORE = """
foxglove: {{address: 127.0.0.1:{foxglove}}}
record: {{directory: recordings, continuous: true}}
"""


@cache
def gps(latitude: float) -> bytes:
    wire = wire_of_protos(PROTOS)
    case = wire.case("gps_info")
    return wire.encode(case, case.message_class(latitude=latitude, longitude=1.0))


class Looked(NamedTuple):
    """What Foxglove, the status page, taps and the recording had of the same datagrams."""

    foxglove: list[float]
    page: list[dict[str, Any]]
    tapped: list[dict[str, Any]]
    accepted_only: list[dict[str, Any]]
    recording: Path
    counted: Counter[str]


def tap(table: Path, count: int, *words: str) -> subprocess.Popen[str]:
    """A process that taps by now."""
    command = [sys.executable, "-m", "router", "tap", *words, "--json", "--count", str(count), "--table", str(table)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert process.stderr.readline().startswith("tapping ")
    return process


def lines(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    out, _ = process.communicate(timeout=PATIENCE)
    return [json.loads(line) for line in out.splitlines()]


def last_value(place: Site) -> dict[str, Any] | None:
    with urllib.request.urlopen(f"http://127.0.0.1:{place.metrics}/status.json", timeout=PATIENCE) as answer:
        values: dict[str, Any] = json.load(answer)["values"]
    return values.get("gps_info")


def latitude(message: Message) -> float:
    found: float = message.latitude  # type: ignore[attr-defined]
    return found


def look(folder: Path) -> Looked:
    with ExitStack() as opened:
        place = opened.enter_context(site(folder))
        port = free_port(kind=socket.SOCK_STREAM)
        table = place.table(ROVER + MORE.replace("{foxglove}", str(port)))
        router = opened.enter_context(RouterProcess(folder, table))
        stranger = opened.enter_context(udp("127.0.0.9"))
        client = opened.enter_context(FoxgloveClient(port))
        client.subscribe("gps_info")
        page = [last_value(place)]  # the look begins
        number = ROUNDS * (TIMES + 1)
        both = opened.enter_context(tap(table, number)), opened.enter_context(tap(table, ROUNDS, "--only", "accepted"))
        before = place.scrape()
        for at in range(ROUNDS):
            for _ in range(TIMES):
                stranger.sendto(gps(FORGED), (ROUTER, place.listen))
            place.send("sensor_board", gps(float(at)))
            place.settle(before, (at + 1) * (TIMES + 1))
            page.append(last_value(place))
        stranger.sendto(gps(FORGED), (ROUTER, place.listen))
        counted = place.settle(before, number + 1)
        wait_until(lambda: _latitude(last_value(place)) == ROUNDS - 1, "the board's last value on the page")
        page.append(last_value(place))
        shown = [latitude(client.receive().message)]
        while shown[-1] != ROUNDS - 1:
            shown.append(latitude(client.receive().message))
        tapped, accepted = map(lines, both)
        assert router.stop(signal.SIGTERM) == 0
    [recording] = (folder / "recordings").glob("*.mcap")
    return Looked(shown, [each for each in page if each], tapped, accepted, recording, counted)


def _latitude(value: dict[str, Any] | None) -> float | None:
    return value["fields"]["latitude"] if value else None


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> Looked:
    return look(tmp_path_factory.mktemp("strangers"))


def test_a_strangers_telemetry_is_rejected_and_counted(looked: Looked) -> None:
    assert total(looked.counted, "datagrams_rejected", reason="source_mismatch") == ROUNDS * TIMES + 1
    assert total(looked.counted, "messages_received", route="gps_info", source="sensor_board") == ROUNDS


def test_foxglove_shows_the_board_alone(looked: Looked) -> None:
    assert looked.foxglove == sorted(set(looked.foxglove))
    assert set(looked.foxglove) <= set(map(float, range(ROUNDS)))


def test_the_status_page_shows_the_board_alone(looked: Looked) -> None:
    assert {value["source"] for value in looked.page} == {"sensor_board"}
    assert {value["fields"]["latitude"] for value in looked.page} <= set(map(float, range(ROUNDS)))


def test_a_tap_marks_what_is_rejected_with_the_reason_or_leaves_it_out(looked: Looked) -> None:
    who = Counter((re.sub(r":\d+$", "", each["peer"]), each.get("rejected")) for each in looked.tapped)
    assert who == {("127.0.0.9", "source_mismatch"): ROUNDS * TIMES, ("sensor_board", None): ROUNDS}
    assert [each["fields"].get("latitude", 0) for each in looked.accepted_only] == list(map(float, range(ROUNDS)))


def test_a_recording_has_everything_in_order_and_the_stranger_on_a_topic_of_its_own(looked: Looked) -> None:
    with looked.recording.open("rb") as file:
        topics = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert topics == {"gps_info": ROUNDS, "rejected/source_mismatch/gps_info": ROUNDS * TIMES + 1}
    found = list(Recording(looked.recording).datagrams())
    order = [*([("", "source_mismatch")] * TIMES), ("sensor_board", "")] * ROUNDS + [("", "source_mismatch")]
    assert [(each.endpoint, each.reason) for each in found] == order


def test_a_board_with_another_address_is_found_out(tmp_path: Path) -> None:
    said = "127.0.0.9 sends messages expected from sensor_board (127.0.0.30)"
    with site(tmp_path) as place, udp("127.0.0.9") as board:
        table = place.table(ROVER)

        def is_told() -> bool:
            board.sendto(gps(1.0), (ROUTER, place.listen))
            return any(said in each.text for each in examine(table, {}))

        with RouterProcess(tmp_path, table):
            wait_until(is_told, "the doctor's finding")
