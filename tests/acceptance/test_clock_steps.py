"""The router stands still while commands arrive, and the wall clock is set meanwhile: none of them reaches a board."""

from __future__ import annotations

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
STALLED_S, SET_BY_S = 2.0, -1.9
"""By the clock as it is afterwards, commands of the stall are 0.1 s old."""

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


@dataclass
class Trial:
    """A route with one destination, and what gives it a command."""

    place: Site
    route: str
    give: Callable[[], None]

    def outcomes(self) -> tuple[int, int]:
        """How many commands were sent, and how many were stale."""
        counts = self.place.scrape()
        return total(counts, "datagrams_sent", route=self.route), total(
            counts, "messages_dropped", route=self.route, reason="stale"
        )

    def drive(self) -> None:
        """Gives commands until one more is sent."""
        before = self.outcomes()[0]

        def is_sent() -> bool:
            self.give()
            return self.outcomes()[0] > before

        wait_until(is_sent, "a command")

    def stall(self, clock: Clock, router: RouterProcess) -> tuple[int, int]:
        """Gives OLD commands while the router stands still, and waits until it has dealt with them."""
        self.drive()
        sent, stale = self.outcomes()
        with router.standing_still():
            for _ in range(OLD):
                self.give()
            time.sleep(STALLED_S)
            clock.set_by(SET_BY_S)
        wait_until(lambda: sum(self.outcomes()) >= sent + stale + OLD, "what became of the old commands")
        assert self.outcomes() == (sent, stale + OLD)
        return sent, stale + OLD


def test_datagrams(place: Site, clock: Clock) -> None:
    datagram = sample("manual_drive", WIRE.envelopes.first.cases["manual_drive"].message_class(turn=5)).datagram
    trial = Trial(place, "manual_drive", lambda: place.send("basestation", datagram))
    with RouterProcess(place.folder, place.table(BARE + ROUTES), **clock.environment) as router:
        sent, stale = trial.stall(clock, router)
        for _ in range(FRESH):
            trial.give()
            time.sleep(0.02)
        wait_until(lambda: sum(trial.outcomes()) == sent + stale + FRESH, "what became of the fresh commands")
        assert trial.outcomes() == (sent + FRESH, stale)


def test_messages_from_ros(place: Site, clock: Clock) -> None:
    """Its publisher's clock is set together with the router's."""
    table = place.table(BARE + ROUTES)
    with (
        RouterProcess(place.folder, table, **clock.environment) as router,
        RosPeer(environment=clock.environment) as talker,
    ):
        talker.open_heard({"drive_motor": "comms/msg/DrivingBoardMotorMessage"})
        trial = Trial(place, "drive_motor", lambda: talker.say("drive_motor", {"distance_to_go": 1.5}))
        trial.stall(clock, router)
        trial.drive()
