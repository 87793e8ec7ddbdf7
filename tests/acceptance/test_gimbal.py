"""The board of docs/guides/request-and-answer.md with the page's table, called by clients in another process."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.service_clients import Service, ServiceClients
from tests.acceptance.service_server import ServiceServer
from tests.acceptance.site import ROOT, RouterProcess, Site, key, site, udp, wait_until
from tests.docs_commands import written
from tests.routers import start

PAGE = ROOT / "docs/guides/request-and-answer.md"
LOCK = Service("gimbal/lock", "std_srvs/srv/SetBool")
TABLE = """\
version: 1
extends: {folder}/gimbal.yaml
http: {{address: 127.0.0.1:{metrics}}}
listen: {{gimbal: {{address: {router}:{listen}}}}}
endpoints: {{gimbal_board: {{address: {board}:{port}}}}}
"""
BOARD = "127.0.0.50"


@dataclass
class Gimbal:
    place: Site
    board: subprocess.Popen[str]
    printed: Path
    clients: ServiceClients

    @contextmanager
    def standing_still(self) -> Iterator[None]:
        """Stop the board meanwhile."""
        self.board.send_signal(signal.SIGSTOP)
        yield
        self.board.send_signal(signal.SIGCONT)

    def lines(self) -> list[str]:
        return self.printed.read_text().split()

    def count(self, metric: str) -> float:
        """The value of a metric of the service `gimbal/lock`."""
        return self.place.samples()[key(metric, service=LOCK.name)]


@pytest.fixture(scope="module")
def clients() -> Iterator[ServiceClients]:
    with ServiceClients() as started:
        yield started


def made(folder: Path, place: Site, port: int) -> Path:
    """Write the files of the page, and return its table with other addresses, which the board has, too."""
    files = written(PAGE)
    files["board.py"] = files["board.py"].replace(
        '("127.0.0.1", 5000), ("127.0.0.2", 5001)', f'("{ROUTER}", {place.listen}), ("{BOARD}", {port})'
    )
    files["table.yaml"] = TABLE.format(
        folder=folder, metrics=place.metrics, router=ROUTER, listen=place.listen, board=BOARD, port=port
    )
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder / "table.yaml"


@pytest.fixture
def gimbal(tmp_path: Path, clients: ServiceClients) -> Iterator[Gimbal]:
    with udp(BOARD) as free:
        port = free.getsockname()[1]
    with site(tmp_path, {}) as place:
        table, printed = made(tmp_path, place, port), tmp_path / "board.log"
        protoc = [sys.executable, "-m", "grpc_tools.protoc", "-I", "protos", "--python_out=.", "gimbal.proto"]
        subprocess.run(protoc, cwd=tmp_path, check=True, timeout=PATIENCE)
        with (
            printed.open("w") as log,
            RouterProcess(tmp_path, table),
            subprocess.Popen([sys.executable, "board.py"], cwd=tmp_path, stdout=log, text=True) as board,
        ):
            try:
                wait_until(lambda: clients.call(LOCK, {"data": False})["success"], "the board")
                yield Gimbal(place, board, printed, clients)
                assert board.poll() is None
            finally:
                board.kill()


def test_a_lock_turns_the_lamp_on(gimbal: Gimbal) -> None:
    assert gimbal.clients.call(LOCK, {"data": True}) == {"success": True, "message": "done"}
    assert gimbal.lines() == ["unlocked", "locked"]
    refused = key("service_calls_total", service="ask_lamp", outcome="unsent")
    wait_until(lambda: gimbal.place.samples()[refused] >= 1, "the call without a server")
    with ServiceServer("lamp") as lamp:  # the board asks again
        assert lamp.request() == "True"
        assert gimbal.clients.call(LOCK, {"data": False}) == {"success": True, "message": "done"}
        assert lamp.request() == "False"
    assert gimbal.lines() == ["unlocked", "locked", "unlocked"]


def test_the_simulator_answers(tmp_path: Path, clients: ServiceClients) -> None:
    with udp(BOARD) as free:
        port = free.getsockname()[1]
    with site(tmp_path, {}) as place:
        table = made(tmp_path, place, port)
        with RouterProcess(tmp_path, table), start(("-m", "router"), "sim", "-t", table) as simulator:
            assert simulator.stdout is not None
            assert simulator.stdout.readline() != ""
            assert clients.call(LOCK, {"data": True}) == {"success": True, "message": "done"}
            answered = key("service_calls_total", service="gimbal/lock", outcome="answered")
            assert place.samples()[answered] == 1
            simulator.send_signal(signal.SIGINT)
            assert simulator.wait(PATIENCE) == 0


def test_a_retry_moves_nothing_twice(gimbal: Gimbal) -> None:
    retries, unmatched = gimbal.count("service_retries_total"), gimbal.count("service_replies_unmatched_total")
    with gimbal.standing_still():
        response = gimbal.clients.begin(LOCK, {"data": True})
        wait_until(lambda: gimbal.count("service_retries_total") > retries, "a retry")
    assert response.get(timeout=PATIENCE) == {"success": True, "message": "done"}
    wait_until(lambda: gimbal.count("service_replies_unmatched_total") > unmatched, "the second reply")
    assert gimbal.lines() == ["unlocked", "locked"]


def test_a_board_that_hangs(gimbal: Gimbal) -> None:
    unmatched = gimbal.count("service_replies_unmatched_total")
    with gimbal.standing_still():
        text = "gimbal_board did not reply within 500 ms"
        assert gimbal.clients.call(LOCK, {"data": True}) == {"success": False, "message": text}
    wait_until(lambda: gimbal.count("service_replies_unmatched_total") >= unmatched + 3, "the late replies")
