"""Processes of the router that tests start."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tests.ports import free_port

ROOT = Path(__file__).parent.parent
MODULE = ("-m", "router")
NOTHING: Mapping[str, str] = MappingProxyType({})


def start(
    how: Sequence[str],
    *arguments: object,
    within: Sequence[str] = (),
    path: str = "",
    environment: Mapping[str, str] = NOTHING,
    **options: Any,
) -> subprocess.Popen[Any]:
    """Start `python HOW ARGUMENT...`, by default with pipes. `within` is a command to run it with.

    It has a port of its own for Foxglove; the one in the rover's table is fixed. Python looks for modules in the folder
    `path` first.
    """
    paths = filter(None, (path, str(ROOT), os.environ.get("PYTHONPATH")))
    own = {"FOXGLOVE": f"127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}", "PYTHONPATH": os.pathsep.join(paths)}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    return subprocess.Popen(
        [*within, sys.executable, *how, *map(str, arguments)],
        env={**os.environ, **own, **environment},
        **{"text": True, **pipes, **options},
    )


def log_until_started(log: Iterable[str]) -> list[str]:
    """Return the lines of a router's log up to "router started". If it ends before, the failure shows it."""
    lines = []
    with suppress(OSError):  # a terminal that was closed at the other end
        for line in log:
            lines.append(line)
            if "router started" in line:
                return lines
    raise AssertionError("the router did not start:\n" + "".join(lines))
