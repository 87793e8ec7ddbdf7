"""The counters balance when more comes in than the router can take, and when destinations are down."""

from __future__ import annotations

import random
import signal
from pathlib import Path

from tests.acceptance.conftest import Rover
from tests.acceptance.payloads import FRAME, generated
from tests.acceptance.rover_map import FLOWS, HOSTS
from tests.acceptance.site import ROVER, RouterProcess, arrived, balance, key, no_room, site, total, udp
from tests.acceptance.test_rejected import REJECTED
from tests.ports import free_port

COUNT = 20_000
GOOD = [sample for case in FLOWS for sample in generated(case)]


def mixed(seed: int) -> list[tuple[str, bytes]]:
    """Datagrams and who sends them: good and bad ones, trimmed, padded, and from those who may not."""
    rng = random.Random(seed)
    bad = [datagram for _, datagram in REJECTED.values()]
    return [one_of(rng, bad) for _ in range(COUNT)]


def one_of(rng: random.Random, bad: list[bytes]) -> tuple[str, bytes]:
    sample = rng.choice(GOOD)
    source = FLOWS[sample.case].source
    form = rng.randrange(10)
    if form == 0:
        return source, rng.choice(bad)
    if form == 1:
        return source, rng.randbytes(rng.randrange(60))
    if form == 2:
        return rng.choice(list(HOSTS)), sample.datagram
    if form == 3:
        return source, sample.datagram.ljust(FRAME, b"\0")
    return source, sample.datagram.rstrip(b"\0") if form < 6 else sample.datagram


def test_the_books_balance_under_load(watched: Rover) -> None:
    place = watched.site
    before, lost = place.scrape(), {name: no_room(opened) for name, opened in place.endpoints.items()}
    for source, datagram in mixed(seed=1):
        place.send(source, datagram)
    now = place.settle(before, COUNT)
    assert total(now, "datagrams_received") + total(now, "kernel_drops") == COUNT
    balance(place.scrape())
    for reason in ("malformed", "source_mismatch", "unknown_case", "truncated", "empty"):
        assert total(now, "datagrams_rejected", reason=reason), reason
    assert total(now, "datagrams_padded")
    assert total(now, "messages_published")
    for name, opened in place.endpoints.items():
        assert total(now, "datagrams_sent", destination=name) == arrived(opened, lost[name])


def test_what_the_kernel_drops_is_counted(watched: Rover) -> None:
    """A router that is stopped for a while receives what its buffer holds, and knows how many more there were."""
    place, process = watched.site, watched.router.process
    datagram = GOOD[0].datagram
    before = place.scrape()
    process.send_signal(signal.SIGSTOP)
    place.send("sensor_board", *[datagram] * COUNT)
    process.send_signal(signal.SIGCONT)
    now = place.settle(before, COUNT)
    assert total(now, "kernel_drops") > 0
    assert total(now, "datagrams_received") + total(now, "kernel_drops") == COUNT
    balance(place.scrape())


DOWN = """\
  container_board:
    address: 127.0.0.50:{down}
routes:
  imu_info:
    destinations: [basestation, container_board, driving_board]
"""


def test_a_destination_that_is_down_does_not_hurt_the_others(tmp_path: Path) -> None:
    hosts = {name: host for name, host in HOSTS.items() if name != "container_board"}
    down = free_port(HOSTS["container_board"])
    imu = [sample.datagram for sample in generated("imu_info")]
    with (
        site(tmp_path, hosts) as place,
        RouterProcess(tmp_path, place.table(ROVER + DOWN.replace("{down}", str(down)))),
    ):
        before = place.scrape()
        for datagram in imu:
            place.send("sensor_board", datagram)
            assert [place.receive(name) for name in ("basestation", "driving_board")] == [datagram, datagram]
        now = place.settle(before, len(imu))
        balance(place.scrape())
        for alive in ("basestation", "driving_board"):
            assert total(now, "datagrams_sent", route="imu_info", destination=alive) == len(imu)
        refused = key("messages_dropped", route="imu_info", target="container_board", reason="send_error")
        assert {name: count for name, count in now.items() if "dropped" in name} == {refused: now[refused]}
        assert now[refused] >= len(imu) - 1

        with udp(HOSTS["container_board"], down) as back:
            for datagram in imu:
                place.send("sensor_board", datagram)
                assert back.recv(1000) == datagram
            after = place.changes(before)
            assert after[refused] - now[refused] <= 1
