"""The router stands still while commands arrive, and the wall clock is set meanwhile: none of them reaches a board."""

from __future__ import annotations

import os
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import HOSTS
from tests.acceptance.site import BARE, RouterProcess, Site, site, total, wait_until

SECOND = 10**9
OLD, FRESH = 5, 20
STALLED_S, SET_BY_S = 2.5, -2.2
"""By the clock as it is afterwards, commands of the stall are 0.3 s old."""

ROUTES = """\
routes:
  manual_drive:
    {{source: basestation, destinations: driving_board, ttl: 1s, deadman: {{none: for this test}}}}
  drive_motor:
    source: {{topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}}
    fields: auto
    destinations: driving_board
    ttl: 1s
    deadman: {{none: for this test}}
"""


@dataclass
class Clock:
    """The wall clock of processes with this environment."""

    file: Path
    environment: Mapping[str, str]

    def set_by(self, seconds: float) -> None:
        self.file.write_bytes(struct.pack("=qq", time.time_ns(), round(seconds * SECOND)))


@pytest.fixture(scope="module")
def clock(tmp_path_factory: pytest.TempPathFactory) -> Clock:
    folder = tmp_path_factory.mktemp("clock")
    library, file = folder / "clock_shift.so", folder / "shift"
    source = Path(__file__).with_name("clock_shift.c")
    subprocess.run(["cc", "-shared", "-fPIC", source, "-o", library], check=True)  # noqa: S607
    file.write_bytes(bytes(16))
    return Clock(file, {"LD_PRELOAD": str(library), "CLOCK_SHIFT": str(file)})


@pytest.fixture
def place(tmp_path: Path, clock: Clock) -> Iterator[Site]:
    clock.file.write_bytes(bytes(16))
    with site(tmp_path, {name: HOSTS[name] for name in ("driving_board", "basestation")}) as place:
        yield place


def of_udp(place: Site) -> Callable[[], None]:
    datagram = sample("manual_drive", WIRE.envelope.cases["manual_drive"].message_class(turn=5)).datagram
    return lambda: place.send("basestation", datagram)


def try_a_stall(place: Site, clock: Clock, router: RouterProcess, route: str, give: Callable[[], None]) -> None:
    def outcomes() -> tuple[int, int]:
        counts = place.scrape()
        sent = total(counts, "datagrams_sent", route=route, destination="driving_board")
        return sent, total(counts, "messages_dropped", route=route, reason="stale")

    def is_driven() -> bool:
        give()
        return outcomes()[0] > 0

    wait_until(is_driven, "a command")
    time.sleep(STALLED_S)  # by then the clocks were looked at for so long
    sent, stale = outcomes()
    with router.standing_still():
        for _ in range(OLD):
            give()
        time.sleep(STALLED_S)
        give()  # whoever commands goes on; this one is fresh
        clock.set_by(SET_BY_S)
    wait_until(lambda: sum(outcomes()) == sent + stale + OLD + 1, "what became of the old commands")
    assert outcomes() == (sent + 1, stale + OLD)
    for _ in range(FRESH):
        give()
        time.sleep(0.02)
    wait_until(lambda: sum(outcomes()) == sent + stale + OLD + 1 + FRESH, "what became of the fresh commands")
    assert outcomes() == (sent + 1 + FRESH, stale + OLD)


def test_datagrams(place: Site, clock: Clock) -> None:
    table = place.table(BARE + ROUTES)
    with RouterProcess(place.folder, table, **clock.environment) as router:
        try_a_stall(place, clock, router, "manual_drive", of_udp(place))


@pytest.mark.skipif(
    os.environ.get("ROUTER_CARRIER") == "python",
    reason="Python counts from the earlier of two stamps, of which one may be from before the step",
)
def test_messages_from_ros(place: Site, clock: Clock) -> None:
    """Its publisher's clock is set together with the router's."""
    table = place.table(BARE + ROUTES)
    with (
        RouterProcess(place.folder, table, **clock.environment) as router,
        RosPeer(environment=clock.environment) as talker,
    ):
        talker.open_heard({"drive_motor": "comms/msg/DrivingBoardMotorMessage"})
        try_a_stall(place, clock, router, "drive_motor", lambda: talker.say("drive_motor", {"distance_to_go": 1.5}))
