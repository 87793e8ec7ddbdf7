"""Stopping under load: in good order, and without losing anything that was received."""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep

import pytest

from tests.acceptance.payloads import generated
from tests.acceptance.site import BARE, ROVER, RouterProcess, Site, arrived, site, wait_until
from tests.tables import PROTOS

RATE = 2000
"""Datagrams per second."""

BATCH = 20
KILLED_AFTER = 10.0
"""Seconds that the systemd unit leaves it."""

WAITING = 5000
"""Datagrams in the kernel's buffer when the signal comes: more than can be routed before it is noticed."""

PH = next(generated("ph_info")).datagram


@contextmanager
def stream(place: Site) -> Iterator[Callable[[], int]]:
    """The sensor board sends all the time; the function says how many datagrams it has sent."""
    sent, ended = 0, threading.Event()

    def send() -> None:
        nonlocal sent
        begin = monotonic()
        while not ended.is_set():
            place.send("sensor_board", *[PH] * BATCH)
            sent += BATCH
            sleep(max(0.0, begin + sent / RATE - monotonic()))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield lambda: sent
    finally:
        ended.set()
        sender.join()


def assert_in_order(router: RouterProcess, code: int) -> dict[str, int]:
    """Exit code 0, nothing alarming, and the last line of the log, which sums up."""
    assert code == 0
    assert "Traceback" not in router.text()
    assert [line["event"] for line in router.log()[-2:]] == ["router stopping", "router stopped"]
    assert not [line for line in router.log() if line["level"] in ("error", "critical")]
    totals: dict[str, int] = router.log()[-1]
    return totals


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_stops_it_under_load(tmp_path: Path, number: signal.Signals) -> None:
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table()) as router:
        with stream(place) as sent:
            wait_until(lambda: sent() >= RATE / 2, "half a second of traffic")
            before, begin = sent(), monotonic()
            code = router.stop(number)
            assert monotonic() - begin < KILLED_AFTER
        totals = assert_in_order(router, code)
        assert before <= totals["datagrams_received"] + totals["kernel_drops"] <= sent() + BATCH
        assert totals["datagrams_rejected"] == totals["messages_dropped"] == 0
        assert totals["datagrams_received"] == totals["datagrams_sent"] == arrived(place.endpoints["basestation"])


TWO_LISTENERS = ROVER.replace("listen:\n", "listen:\n  second:\n    address: 127.0.0.6:{listen}\n")


def test_what_has_arrived_when_the_signal_comes_is_still_routed(tmp_path: Path) -> None:
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table(TWO_LISTENERS)) as router:
        with router.standing_still():
            place.send("sensor_board", *[PH] * WAITING)
            router.process.send_signal(signal.SIGTERM)
        totals = assert_in_order(router, router.wait())
        assert totals["datagrams_received"] + totals["kernel_drops"] == WAITING
        assert totals["datagrams_received"] == totals["datagrams_sent"] == arrived(place.endpoints["basestation"])


DRIVEN = (
    BARE.replace("{root}/tests/rover/protos", "protos")
    + """\
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1h
    deadman: {{timeout: 1h, at_start: silent, send: {{manual_brake: {{brake: true}}}}}}
"""
)


@contextmanager
def stuck(path: Path, begin: Callable[[], None]) -> Iterator[None]:
    """A file that never ends to whoever reads it after `begin`, as on a computer that does not answer."""
    os.mkfifo(path)
    opened: list[int] = []

    def is_read() -> bool:
        with suppress(OSError):  # nobody reads it yet
            opened.append(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
        return bool(opened)

    begin()
    wait_until(is_read, "that it is read")
    yield
    os.close(opened[0])


def test_a_reload_that_is_stuck_delays_no_brake(tmp_path: Path) -> None:
    shutil.copytree(PROTOS, tmp_path / "protos")
    drive = next(generated("manual_drive")).datagram
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table(DRIVEN)) as router:
        place.send("basestation", drive)
        assert place.receive("driving_board") == drive
        with stuck(tmp_path / "protos" / "stuck.proto", lambda: router.process.send_signal(signal.SIGHUP)):
            begin = monotonic()
            assert router.stop(signal.SIGTERM) == 0
            assert monotonic() - begin < KILLED_AFTER
        assert len(place.waiting()["driving_board"]) == 1
