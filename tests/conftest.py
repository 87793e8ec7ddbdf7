"""What holds for every test: a ROS domain of this run alone that never leaves the machine, and the carrier."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path

import pytest
from hypothesis import settings

from router.carrier.build import build, is_current

# Routers of tests run on the library of the sources that there are now.
if not is_current():
    build()

from tests.gateway.browser import Browser, executable
from tests.lanes import LANE

# Before anything imports rclpy. Domains above 101 would use ports that the kernel gives to others.
os.environ["ROS_DOMAIN_ID"] = str(1 + LANE)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

# The rover's table records what came before a deadman trips.
_recordings = tempfile.TemporaryDirectory(prefix="recordings-")
os.environ["RECORDINGS"] = _recordings.name

# Routers keep what they compile.
_cache = tempfile.TemporaryDirectory(prefix="cache-")
os.environ["XDG_CACHE_HOME"] = _cache.name

# A shell lets what it starts in the background ignore Ctrl-C, and children inherit that; tests send it to them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: how long an example takes says more about the machine than about the code.
settings.register_profile("quick", deadline=None, max_examples=25)
settings.register_profile("full", deadline=None, max_examples=200)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))


_ROOT = Path(__file__).parents[1]
TEAMS = (f"{_ROOT}/routes/", f"{_ROOT}/protos/")
"""What a team edits. A test that reads it would fail with the next basestation: tests/tables.py has other tables."""


def _leave_to_the_team(event: str, arguments: tuple[object, ...]) -> None:
    if event != "open" or not isinstance(path := arguments[0], str):
        return
    if os.path.abspath(path).startswith(TEAMS):  # noqa: PTH100 - `resolve` would look at the disk each time
        raise AssertionError(f"a test opens {path}, which is the team's; use tests/tables.py")


sys.addaudithook(_leave_to_the_team)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mix files from both ends of the list, for workers that take one after the other: most of the first ones wait."""
    if not hasattr(config, "workerinput"):
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    left, turns = deque(files.values()), cycle((deque.popleft, deque.pop))
    items[:] = [item for _ in files for item in next(turns)(left)]


@pytest.fixture(scope="session", autouse=True)
def _in_the_checkout() -> None:
    """Wherever the tests were started: files below here are told by their path from here."""
    os.chdir(Path(__file__).parent.parent)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Headless Chromium: pages are tested in a real browser only."""
    program = executable()
    if program is None:
        pytest.skip("no Chromium here")
    running = Browser(program, tmp_path_factory.mktemp("chromium"))
    yield running
    running.close()
