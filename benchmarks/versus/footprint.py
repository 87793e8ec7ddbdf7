"""How long a process takes until it works, at its first start and when it was killed and starts again; its memory.

The second start is that of the same command with the same ports, so a router has what it kept for it. Metrics of the
second one are `METRIC@again`.
"""

from __future__ import annotations

import os
import signal
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import cast

from benchmarks.versus.contenders import Ports, Router, datagrams
from benchmarks.versus.helpers import IMU, SENSOR_BOARD, Helper, first_message
from benchmarks.versus.runs import Traffic, run
from benchmarks.versus.subject import START_SECONDS, Subject
from benchmarks.versus.trial import Metrics, Trial
from router.net.ready import readable
from router.tools.running_router import post

RATE, SECONDS = 5000, 60
EVERY = 0.002
"""Seconds between the datagrams of which the first that is routed counts."""
RELOAD_SECONDS = 60


def start_and_memory(trial: Trial) -> Metrics:
    """`start_s`, `brake_s`, `ros_s`: see `_working`; `rss_mb` in 10^6 bytes, of the first start after its load."""
    with _keeping(trial) as ports:
        with _working(trial, ports) as (subject, metrics):
            load = run(subject, Traffic(RATE, min(SECONDS, trial.pace.longest)), trial.pace)
            metrics["rss_mb"] = round(subject.rss_mb(), 2)
            load.add_to(metrics, "")
        with _working(trial, ports) as (_, again):
            pass
    return metrics | {f"{name}@again": value for name, value in again.items()}


def start_and_reload(trial: Trial) -> Metrics:
    """`reload_s`: of a table in which a comment has changed."""
    table = cast("Router", trial.contender).table
    with _keeping(trial) as ports:
        text = table.read_text(encoding="utf-8")
        try:
            with _working(trial, ports) as (_, metrics):
                table.write_text(f"{text}# changed\n", encoding="utf-8")
                os.utime(table, (time.time() - 60,) * 2)  # or the reload waits until it rests
                asked, began = time.time(), time.monotonic()
                answer = post(f"http://127.0.0.1:{ports.metrics}", "/-/reload", RELOAD_SECONDS)
                metrics["reload_s"] = round(time.monotonic() - began, 4)
                if not answer.ok:
                    raise SystemExit(f"the reload failed: {answer.body}")
                _wait_until_kept(asked)
            with _working(trial, ports) as (_, again):
                pass
        finally:
            table.write_text(text, encoding="utf-8")
    return metrics | {f"{name}@again": value for name, value in again.items()}


@contextmanager
def _keeping(trial: Trial) -> Iterator[Ports]:
    """The ports of all starts, while routers keep their programs in a folder that is empty at the beginning."""
    with tempfile.TemporaryDirectory(dir=trial.folder) as folder:
        before = os.environ["STATE_DIRECTORY"]
        os.environ["STATE_DIRECTORY"] = folder
        try:
            yield Ports.free()
        finally:
            os.environ["STATE_DIRECTORY"] = before


def _wait_until_kept(since: float) -> None:
    """Returns when a program has been kept since then."""
    deadline = time.monotonic() + START_SECONDS
    folder = Path(os.environ["STATE_DIRECTORY"], "kept")
    while not any(path.stat().st_mtime > since for path in folder.glob("*.program")):
        if time.monotonic() > deadline:
            raise SystemExit("no program was kept")
        time.sleep(0.01)


@contextmanager
def _working(trial: Trial, ports: Ports) -> Iterator[tuple[Subject, Metrics]]:
    """A process that has just done all of its first work, and rested; it is killed at the end.

    Seconds from its start to the first datagram at its destination (`start_s`), to the first datagram at its
    contender's board (`brake_s`), if it has one, and to the first message on ROS (`ros_s`), which has a subscriber
    from the beginning.
    """
    with ExitStack() as ending:
        with ExitStack() as opened:
            sender = opened.enter_context(_bound(SENSOR_BOARD.partition(":")[0], 0))
            awaited: dict[socket.socket | Helper, str] = {
                opened.enter_context(_bound("127.0.0.1", ports.first)): "start_s",
                opened.enter_context(first_message(IMU)): "ros_s",
            }
            if trial.contender.board:
                awaited[opened.enter_context(_bound(*trial.contender.board))] = "brake_s"
            began = time.monotonic()
            subject = ending.enter_context(trial.start(ports))
            datagram = dict(reversed(datagrams(trial.contender.payloads)))[IMU.case]
            metrics: Metrics = {}
            while awaited:
                for each in readable(awaited, EVERY):
                    metrics[awaited.pop(each)] = round(time.monotonic() - began, 4)
                sender.sendto(datagram, ("127.0.0.1", ports.listen[0]))
                subject.check(began + START_SECONDS)
        time.sleep(trial.pace.settle)
        yield subject, metrics
        subject.end(signal.SIGKILL)


def _bound(host: str, port: int) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((host, port))
    return opened
