"""A router on a kernel that lacks options of sockets, as an emulator or a sandbox does: what it still knows."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import sleep

import pytest

from tests.acceptance.payloads import WIRE
from tests.acceptance.rover_map import HOSTS
from tests.acceptance.site import BARE, RouterProcess, Site, site, total, wait_until

TABLE = (
    BARE.replace("address: 127.0.0.5:{listen}", "address: 127.0.0.5:{listen}, receive_buffer: 4KiB")
    + """\
routes:
  manual_drive: {{source: basestation, destinations: driving_board, ttl: 200ms, deadman: {{none: for this test}}}}
"""
)
DRIVE = WIRE.envelopes.first.message_class(manual_drive={"turn": 5}).SerializeToString()
OLD, OLD_FOR_S = 3, 0.5
FLOOD = 1000
ASKS = "the kernel does not send arrival times with datagrams: each datagram costs one more system call"
LACKS = "the kernel provides no arrival times: 'ttl' ignores the time spent in the receive buffer"


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Site]:
    with site(tmp_path, {name: HOSTS[name] for name in ("driving_board", "basestation")}) as place:
        yield place


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """The environment of processes for which it is another one."""
    library = tmp_path_factory.mktemp("kernel") / "other_kernel.so"
    source = Path(__file__).with_name("other_kernel.c")
    subprocess.run(["cc", "-shared", "-fPIC", source, "-o", library], check=True)  # noqa: S607
    return {"LD_PRELOAD": str(library)}


def given_while_it_stands_still(place: Site, router: RouterProcess) -> tuple[int, int]:
    """How many of OLD commands were sent, and how many were stale."""
    with router.standing_still():
        place.send("basestation", *OLD * [DRIVE])
        sleep(OLD_FOR_S)
    wait_until(lambda: total(place.scrape(), "messages_received") == OLD, "the commands")
    counts = place.scrape()
    return total(counts, "datagrams_sent"), total(counts, "messages_dropped", reason="stale")


def warnings(router: RouterProcess) -> list[str]:
    return [line["event"] for line in router.log() if "arrival times" in line["event"]]


def test_without_stamps_in_messages_it_asks_for_them(place: Site, kernel: Mapping[str, str]) -> None:
    with RouterProcess(place.folder, place.table(TABLE), **kernel) as router:
        assert given_while_it_stands_still(place, router) == (0, OLD)
        place.send("basestation", DRIVE)
        assert place.receive("driving_board") == DRIVE
        assert warnings(router) == [ASKS]


def test_without_any_stamps_datagrams_count_from_when_they_are_read(place: Site, kernel: Mapping[str, str]) -> None:
    environment = {**kernel, "NO_STAMPS": "1"}
    with RouterProcess(place.folder, place.table(TABLE), **environment) as router:
        assert given_while_it_stands_still(place, router) == (OLD, 0)
        assert warnings(router)[-1:] == [LACKS]


def test_without_its_count_for_a_socket_drops_are_known(place: Site, kernel: Mapping[str, str]) -> None:
    with RouterProcess(place.folder, place.table(TABLE), **kernel) as router:
        with router.standing_still():
            place.send("basestation", *FLOOD * [DRIVE])
        wait_until(lambda: _received_or_lost(place) == FLOOD, "the flood")
        assert total(place.scrape(), "kernel_drops") > 0
        assert router.stop(signal.SIGTERM) == 0


def _received_or_lost(place: Site) -> int:
    counts = place.scrape()
    return total(counts, "datagrams_received") + total(counts, "kernel_drops")
