"""How long a process takes to route its first datagram, and how much memory it has after a minute's load."""

from __future__ import annotations

import select
import socket
import time

from benchmarks.versus.contenders import datagrams
from benchmarks.versus.helpers import SENSOR_BOARD
from benchmarks.versus.runs import Traffic, run
from benchmarks.versus.subject import START_SECONDS, Subject
from benchmarks.versus.trial import Metrics, Trial

RATE, SECONDS = 5000, 60
EVERY = 0.002
"""Seconds between the datagrams of which the first that is routed counts."""


def start_and_memory(trial: Trial) -> Metrics:
    """`start_s`: from the start of the process to the first datagram at its destination; `rss_mb` in 10^6 bytes."""
    metrics: Metrics = {}
    began = time.monotonic()
    with trial.start() as subject:
        wait_until_routed(subject)
        metrics["start_s"] = round(time.monotonic() - began, 4)
        time.sleep(trial.pace.settle)
        load = run(subject, Traffic(RATE, min(SECONDS, trial.pace.longest)), trial.pace)
        metrics["rss_mb"] = round(subject.rss_mb(), 2)
        load.add_to(metrics, "")
    return metrics


def wait_until_routed(subject: Subject) -> None:
    """Knocks until the subject lets a datagram through."""
    _, datagram = datagrams(subject.contender.payloads)[0]
    deadline = time.monotonic() + START_SECONDS
    with _bound(SENSOR_BOARD.partition(":")[0], 0) as sender, _bound("127.0.0.1", subject.ports.first) as receiver:
        while not select.select([receiver], [], [], EVERY)[0]:
            sender.sendto(datagram, ("127.0.0.1", subject.ports.listen[0]))
            subject.check(deadline)


def _bound(host: str, port: int) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((host, port))
    return opened
