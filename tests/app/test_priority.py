"""The policies that the threads of a running router have, by what it may and by what started it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.acceptance.site import RouterProcess, site, wait_until
from tests.tasks import name_of, of_threads

THREADS = {"receive", "timers", "ros urgent"}
UNPRIVILEGED = ("setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice")


@pytest.mark.skipif(os.geteuid() != 0, reason="gives and takes the right to a real-time priority, as root may")
@pytest.mark.parametrize(
    ("within", "policy"),
    [
        ((), os.SCHED_FIFO),
        (UNPRIVILEGED, os.SCHED_OTHER),
        (("prlimit", "--rtprio=1", *UNPRIVILEGED), os.SCHED_FIFO),
    ],
)
def test_native_threads_run_first_where_they_may(within: Sequence[str], policy: int, tmp_path: Path) -> None:
    if subprocess.run(["/usr/bin/env", *within, "true"], capture_output=True, check=False).returncode:
        pytest.skip(f"no {within[0]} here, or it may not do this")
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table(), within=within) as router:
        wait_until(lambda: all(policies(router).get(name) == policy for name in THREADS), f"policy {policy}")
        others = {each for name, each in policies(router).items() if name not in THREADS}
        assert others.isdisjoint({os.SCHED_FIFO, os.SCHED_RR})


def policies(router: RouterProcess) -> dict[str, int]:
    """By the name of the thread, which asks for its own when it first runs."""
    return dict(of_threads(router.process.pid, lambda task: (name_of(task), os.sched_getscheduler(int(task.name)))))
