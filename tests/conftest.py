"""Set-up for every test: a current build of the carrier, and a private ROS domain that stays on this computer."""

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

# Tests run with a library built from the current sources.
if not is_current():
    build()

from tests.gateway.browser import Browser, executable
from tests.lanes import LANE

# Before anything imports rclpy. Domains above 101 would use the kernel's ephemeral ports.
os.environ["ROS_DOMAIN_ID"] = str(1 + LANE)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

# The rover's table records what came before a deadman trips.
_recordings = tempfile.TemporaryDirectory(prefix="recordings-")
os.environ["RECORDINGS"] = _recordings.name

# Routers keep compiled programs there.
_cache = tempfile.TemporaryDirectory(prefix="cache-")
os.environ["XDG_CACHE_HOME"] = _cache.name

# Shells make background jobs ignore SIGINT, and children inherit that; tests send SIGINT to children.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: the time of an example depends on the machine more than on the code.
settings.register_profile("quick", deadline=None, max_examples=25)
settings.register_profile("full", deadline=None, max_examples=200)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))


_ROOT = Path(__file__).parents[1]
TEAMS = (f"{_ROOT}/routes/", f"{_ROOT}/protos/")
"""Folders that a team edits. Tests must not read them, or every edit could break tests: use tests/tables.py."""


def _leave_to_the_team(event: str, arguments: tuple[object, ...]) -> None:
    if event != "open" or not isinstance(path := arguments[0], str):
        return
    if os.path.abspath(path).startswith(TEAMS):  # noqa: PTH100 - `resolve` would look at the disk each time
        raise AssertionError(f"a test opens {path}, which is the team's; use tests/tables.py")


sys.addaudithook(_leave_to_the_team)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Alternate between files from both ends of the list: most tests at its beginning wait, and workers go in order."""
    if not hasattr(config, "workerinput"):
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    left, turns = deque(files.values()), cycle((deque.popleft, deque.pop))
    items[:] = [item for _ in files for item in next(turns)(left)]


@pytest.fixture(scope="session", autouse=True)
def _in_the_checkout() -> None:
    """Run from the checkout's root, wherever pytest was started: tests name files relative to it."""
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
