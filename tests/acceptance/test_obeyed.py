"""Boards that obey the brake of a deadman, and one that does not: what a running router says about them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from router.observe.problems import Kind, Problem
from router.recording.reader import Recording
from router.tools.running_router import health
from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.site import BARE, RouterProcess, Site, key, site, wait_until

TABLE = (
    BARE
    + """\
record: {{directory: recordings, continuous: false, last: 60s}}
routes:
  manual_drive:
    source: basestation
    destinations: driving_board
    deadman:
      timeout: 100ms
      send: {{manual_brake: {{brake: true}}}}
      obeyed: {{drive_diag: abs(front_left_motor.rpm) < 5, within: 300ms}}
  drive_diag: {{source: driving_board, destinations: basestation}}
"""
)
HOSTS = {"driving_board": "127.0.0.222", "basestation": "127.0.0.10"}
LABELS = {"route": "manual_drive", "endpoint": "driving_board"}
STOPPED, DISOBEYED = "the board has stopped", "the board does not obey the brake; stop the rover by other means"


def envelope(case: str, **values: object) -> bytes:
    return sample(case, WIRE.envelopes.first.cases[case].message_class(**values)).datagram


DRIVE, MOVES = envelope("manual_drive", turn=5), envelope("drive_diag", front_left_motor={"rpm": 300})
STANDS = envelope("drive_diag", front_left_motor={"rpm": 1})


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Site]:
    with site(tmp_path, HOSTS) as opened:
        yield opened


def problems(place: Site) -> list[Problem]:
    found = health(f"http://127.0.0.1:{place.metrics}").problems
    return [each for each in found if each.kind is Kind.DEADMAN_DISOBEYED]


def recorded_answers(place: Site) -> str:
    """The note in the only recording, once the router has ended."""
    [path] = (place.folder / "recordings").iterdir()
    with closing(Recording(path)) as recording:
        for _ in recording.datagrams():
            pass
        return recording.about["obeyed"]


def test_a_board_that_does_not_obey_is_a_problem_until_it_stops(place: Site) -> None:
    with RouterProcess(place.folder, place.table(TABLE)) as router:
        place.send("basestation", DRIVE)
        wait_until(lambda: bool(router.events(DISOBEYED)), "the report")
        [line] = router.events(DISOBEYED)
        assert line["detail"] == "it was sent manual_brake {brake: true}, and has sent no drive_diag since"
        assert place.samples()[key("deadman_disobeyed", **LABELS)] == 1
        place.send("driving_board", MOVES)
        says = "and says drive_diag front_left_motor.rpm=300"
        wait_until(lambda: any(each.text.endswith(says) for each in problems(place)), "what it says")
        place.send("driving_board", STANDS)
        wait_until(lambda: bool(router.events(STOPPED)), "the stop")
        assert problems(place) == []
        samples = place.samples()
        assert samples[key("deadman_disobeyed", **LABELS)] == 0
        assert samples[key("deadman_stopping_seconds_count", **LABELS)] == 1
        assert samples[key("deadman_stopping_seconds_sum", **LABELS)] > 0.3
    assert recorded_answers(place).startswith("manual_drive: driving_board did not obey for 0.")


def test_a_board_that_obeys_is_timed_and_the_recording_says_so(place: Site) -> None:
    with RouterProcess(place.folder, place.table(TABLE)) as router:
        place.send("basestation", DRIVE)

        def has_stopped() -> bool:
            place.send("driving_board", STANDS)
            return bool(router.events(STOPPED))

        wait_until(has_stopped, "the stop")
        assert place.samples()[key("deadman_stopping_seconds_count", **LABELS)] == 1
        assert router.events(DISOBEYED) == []
    assert recorded_answers(place).startswith("manual_drive: driving_board stopped after 0.")
