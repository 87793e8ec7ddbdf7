"""Imports before a head start's threads run. A medium-sized module takes 3 ms on the rover's computer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

SLOW = {
    "argparse", "asyncio", "dataclasses", "hashlib", "inspect", "json", "logging", "pathlib", "pickle", "re",
    "subprocess", "tempfile", "typing", "yaml",
}  # fmt: skip
"""Modules of the standard library that other modules import anyway."""

LOG = {"router", "router.clock", "router.log", "router.shortage"}
GROUND = {"router.declared", *LOG}
NET = {"router.hosts", "router.net", "router.net.addresses", "router.net.kernel", "router.net.sockets"}


def imported(script: str) -> set[str]:
    """The modules that a script imports, without third-party packages, which it cannot find."""
    told = "\nimport sys; print(*sys.modules)"
    command = [sys.executable, "-S", "-c", script + told]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {*done.stdout.split()}


@pytest.mark.parametrize(
    ("script", "ours"),
    [
        ("import router", {"router"}),
        ("from router.log import logger, FloodLog; FloodLog()", LOG),
        ("import router.net.sockets", {*LOG, *NET}),
        (
            "from router.library import library; from router.carrier import forwarding_threads, sender; library()",
            {
                "router.carrier", "router.library", "router.carrier.ring", "router.carrier.threads",
                "router.carrier.forwarding_threads", "router.carrier.sender", *GROUND, *NET,
            },
        ),
        (
            "import router.startup_image.head_start",
            {
                "router.carrier", "router.library", "router.carrier.ring", "router.carrier.threads",
                "router.carrier.forwarding_threads", "router.carrier.sender", "router.carrier.deadmen",
                "router.carrier.owned",
                "router.carrier.forwarding", "router.carrier.loading", "router.image", "router.image.image",
                "router.image.names", "router.inputs",
                "router.startup_image", "router.startup_image.store", "router.startup_image.head_start", *GROUND, *NET,
            },
        ),
    ],
)  # fmt: skip
def test_what_a_head_start_uses_imports_little(script: str, ours: set[str]) -> None:
    found = imported(script)
    assert {name for name in found if name.partition(".")[0] == "router"} == ours
    assert found & SLOW == set()
