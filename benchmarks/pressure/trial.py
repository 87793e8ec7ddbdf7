"""One run: a fresh process of a subject under one pressure, and its figures."""

from __future__ import annotations

import json
import os
import random
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.deadman_sources import envelope_class
from benchmarks.pressure import tables, traffic
from benchmarks.pressure.figures import Round, quantiles
from benchmarks.pressure.pressures import Pressed, Pressure, metrics, total
from benchmarks.pressure.tables import Place
from benchmarks.versus.contenders import ORDINARY, PAYLOADS, Ports, Router, datagrams
from benchmarks.versus.helpers import Helper
from benchmarks.versus.subject import Meter, Subject
from benchmarks.versus.trial import Metrics

HERE = Path(__file__).parent
FIRST, DRIVING_BOARD, ARM_BOARD = range(3)
"""In the order of `Place.destinations`."""

MS = 1_000_000
MOST_AGE = (tables.TTL_MS + 50) * MS
"""A command that takes longer was sent too late by the router: it goes stale after the ttl."""

WARM_UP = 1000
NOISE_LIMIT = 0.05
AFTER_SECONDS = 1.0
FLOOD_RATE = 20_000
QUANTILES = {"p50": 0.5, "p99": 0.99, "max": 1.0}


@dataclass(frozen=True)
class Command(Router):
    """A subject that is started by a command of one's own.

    TABLE in it is the path of the table; LISTEN, FIRST and SECOND are addresses, for those that take no table.
    """

    command: str = ""

    @property
    def is_router(self) -> bool:
        return "TABLE" in shlex.split(self.command)

    def words(self, ports: Ports) -> list[object]:
        known = {
            "TABLE": str(self.table),
            "LISTEN": f"127.0.0.1:{ports.listen[0]}",
            "FIRST": f"{tables.BASESTATION}:{ports.first}",
            "SECOND": f"127.0.0.1:{ports.second}",
        }
        start = () if self.realtime else ORDINARY
        return [*start, *(known.get(word, word) for word in shlex.split(self.command))]

    def environment(self, ports: Ports) -> dict[str, str]:
        """A native program finds ROS's libraries by what the wheels set in ours; Python starts as from a shell."""
        return super().environment(ports) if self.is_router else dict(os.environ)


@dataclass(frozen=True)
class Settings:
    """Of all runs. `programs` is where `send` and `receive` are."""

    rate: float
    seconds: float
    seed: int
    folder: Path
    programs: Path


def build(folder: Path) -> None:
    for program in ("send", "receive"):
        command = ["cc", "-O2", "-Wall", "-Wextra", "-std=gnu11", HERE / f"{program}.c", "-o", folder / program]
        subprocess.run([*map(str, command)], check=True)


class Trial:
    """One run, in a folder of its own. `number` makes its traffic differ from that of others."""

    def __init__(self, subject: Command, pressure: Pressure, settings: Settings, number: int) -> None:
        self._name = f"{subject.name}-{pressure.name}-{number}"
        self._settings = settings
        self._pressure = pressure
        self._place = place = Place.free(settings.folder / self._name)
        self._command = replace(subject, table=place.table)
        self._noise = random.Random(f"{settings.seed} {number}")
        self._first = 0
        place.table.write_text(tables.table(place, pressure.name))
        self._envelope: Any = envelope_class(place.table)

    def run(self) -> Round:
        settings, place, is_router = self._settings, self._place, self._command.is_router
        plan = self._telemetry(settings.rate, settings.seconds)
        udp = traffic.bursts(settings.seconds, self._noise) if is_router else []
        ros = traffic.bursts(settings.seconds, self._noise) if is_router else []
        plan = traffic.with_commands(plan, udp, self._manual_drive)
        with ExitStack() as opened:
            log = place.folder / "arrivals"
            receiver = opened.enter_context(self._receiver(log))
            subject = opened.enter_context(self._start())
            subject.wait_until_bound()
            if is_router:
                metrics(place.metrics)  # which answers when all else is there
            self._sent(self._telemetry(WARM_UP, 1))
            self._sent(self._telemetry(FLOOD_RATE, self._pressure.before / FLOOD_RATE))
            commander = opened.enter_context(self._commander(ros)) if ros else None
            before = metrics(place.metrics) if is_router else {}
            conditions = subject.conditions()
            with self._pressure.press(Pressed(subject, place)) as judge:
                meter, began = Meter(subject), time.monotonic()
                if commander:
                    commander.go()
                first = self._first
                sent, told = self._sent(plan)
                proof = judge(time.monotonic() - began)
                meter.read()
                time.sleep(AFTER_SECONDS)
                end = time.time_ns()
            if commander:
                commander.result()
            after = metrics(place.metrics) if is_router else {}
            ended = receiver.stop()
        arrivals: Any = np.fromfile(log, dtype=traffic.ARRIVAL)
        result: Metrics = conditions | {"cpu_us": round(meter.cpu_ns / 1e3 / max(1, told["sent"] - meter.drops), 2)}
        result |= {"noise": round(meter.noise, 3), "generator_slips": told["slips"]}
        result |= self._forwarded(plan, sent, first, arrivals)
        if is_router:
            result |= self._braked("udp", arrivals, DRIVING_BOARD, _split(sent[plan.of(traffic.BOARD)], udp), end)
            published = json.loads((place.folder / "published").read_text())
            result |= self._braked("ros", arrivals, ARM_BOARD, _split(published, ros), end)
            result["brakes_missing"] = result["brakes_missing_udp"] + result["brakes_missing_ros"]
            result |= _counted(before, after)
        invalid = [] if proof.pressed else [f"no pressure: {proof.figures}"]
        invalid += [f"the receiver lost {ended['drops']}"] if ended["drops"] else []
        invalid += [f"{told['errors']} could not be sent"] if told["errors"] else []
        return Round(result, proof.figures, invalid)

    def _telemetry(self, rate: float, seconds: float) -> traffic.Plan:
        return traffic.telemetry([datagram for _, datagram in datagrams(PAYLOADS)], rate, seconds, self._noise)

    def _manual_drive(self, number: int) -> bytes:
        made: bytes = self._envelope(manual_drive={"forward_backward": number}).SerializeToString()
        return made

    def _start(self) -> Subject:
        place = self._place
        return Subject(
            self._command, Ports((place.listen,), place.first, place.second, place.metrics), place.folder / "log"
        )

    def _receiver(self, log: Path) -> Helper:
        listens = [word for address in self._place.destinations() for word in ("--listen", address)]
        helper = Helper(self._settings.programs / "receive", *listens, "--log", log)
        helper.result()
        return helper

    def _commander(self, times: Sequence[Sequence[float]]) -> Helper:
        """One that has found the router."""
        path = self._place.folder / "times"
        path.write_text(json.dumps([time for burst in times for time in burst]))
        words = ("commander", path, self._place.folder / "published")
        helper = Helper(sys.executable, "-m", "benchmarks.pressure.actors", *words)
        helper.result()
        time.sleep(0.5)  # found in the graph is not yet matched on the wire
        return helper

    def _sent(self, plan: traffic.Plan) -> tuple[traffic.Numbers, dict[str, Any]]:
        """Sends it; when each datagram was sent, and what `send` tells of it all."""
        folder = self._place.folder
        payloads, path = plan.write(folder)
        words = ["--to", f"127.0.0.1:{self._place.listen}", "--payloads", payloads, "--plan", path]
        words += ["--log", folder / "sent", "--first", self._first]
        words += [word for host in (tables.SENSOR_BOARD, tables.BASESTATION) for word in ("--from", f"{host}:0")]
        with Helper(self._settings.programs / "send", *words) as helper:
            told = helper.result()
        self._first += len(plan.due)
        return np.fromfile(folder / "sent", dtype="<i8"), told

    def _forwarded(self, plan: traffic.Plan, sent: traffic.Numbers, first: int, arrivals: Any) -> Metrics:
        ours = arrivals[arrivals["port"] == FIRST]
        lines = plan.of(traffic.TELEMETRY)
        found = traffic.passage(sent, lines, first, traffic.numbers(ours["head"]), ours["at"])
        named = {f"udp_{name}_us": part for name, part in QUANTILES.items()}
        result = quantiles([ns / 1e3 for ns in found.latency], named)
        return result | {"lost": found.lost, "doubled": found.doubled}

    def _braked(self, name: str, arrivals: Any, port: int, sent: list[list[int]], end: int) -> Metrics:
        ours = np.sort(arrivals[arrivals["port"] == port], order="at")
        came = [self._read(int(one["at"]), one["head"][: one["length"]].tobytes()) for one in ours]
        found = traffic.braking(sent, came, tables.TIMEOUT_MS * MS, MOST_AGE, end)
        named = {f"brake_{name}_{quantile}_ms": QUANTILES[quantile] for quantile in ("p50", "max")}
        result = quantiles([ns / 1e6 for ns in found.late], named)
        counts = {"brakes_missing": found.missing, "old_commands": found.old, "lost_commands": found.lost}
        return result | {f"{what}_{name}": count for what, count in counts.items()}

    def _read(self, at: int, datagram: bytes) -> traffic.Command:
        envelope = self._envelope.FromString(datagram)
        match envelope.WhichOneof("payload"):
            case "manual_drive":
                return traffic.Command(at, envelope.manual_drive.forward_backward)
            case "drive_motor":
                return traffic.Command(at, round(envelope.drive_motor.distance_to_go))
            case _:
                return traffic.Command(at, None)


def _split(flat: Sequence[int], times: Sequence[Sequence[float]]) -> list[list[int]]:
    """As the bursts of `times` are."""
    rest = iter(flat)
    return [[int(next(rest)) for _ in burst] for burst in times]


def _counted(before: dict[str, float], after: dict[str, float]) -> Metrics:
    """What /metrics counted in the run."""
    dropped = "router_messages_dropped_total"
    asked = {
        "stale": (dropped, 'reason="stale"'),
        "dropped": (dropped,),
        "kernel_drops": ("router_kernel_drops_total",),
        "rejected": ("router_datagrams_rejected_total",),
        "mirror_dropped": ("router_mirror_dropped_total",),
        "trips": ("router_deadman_trips_total",),
    }
    return {name: total(after, *words) - total(before, *words) for name, words in asked.items()}
