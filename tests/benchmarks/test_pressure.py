"""What the benchmark of pressures makes of what was sent and of what came."""

from __future__ import annotations

import random
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.pressure import tables, traffic
from benchmarks.pressure.figures import Round, Row, quantiles, row, text, verdict
from benchmarks.pressure.tables import Place
from benchmarks.pressure.traffic import Braking, Command, Payload, Plan
from benchmarks.pressure.trial import build
from benchmarks.versus.contenders import PAYLOADS, datagrams
from benchmarks.versus.figures import Spread
from router.compiler import check_table
from tests.ports import free_port

SENT = [[100, 200], [2000, 2100]]
TIMEOUT, END, MOST_AGE = 500, 4000, 90


def planned(seed: int) -> Plan:
    return traffic.telemetry([datagram for _, datagram in datagrams(PAYLOADS)], 1000, 2, random.Random(seed))


def test_the_same_seed_is_the_same_traffic() -> None:
    first, again, other = planned(1), planned(1), planned(2)
    assert (first.due == again.due).all()
    assert (first.payload == again.payload).all()
    assert (first.payload != other.payload).any()


def test_telemetry_is_in_order_and_as_long_as_it_should_be() -> None:
    due = planned(1).due
    assert len(due) == 2000
    assert (np.diff(due) > 0).all()
    assert due[0] >= 0
    assert due[-1] <= 2 * traffic.SECOND


def test_behind_each_burst_of_commands_there_is_time_for_a_brake() -> None:
    times = traffic.bursts(10, random.Random(1))
    assert len(times) >= 5
    ends = [*(burst[0] for burst in times[1:]), 10.0]
    assert all(end - burst[-1] >= traffic.SILENCE for burst, end in zip(times, ends, strict=True))


def test_commands_are_numbered_in_the_order_of_the_plan() -> None:
    plan = traffic.with_commands(planned(1), [[0.1, 0.2], [1.5]], lambda number: bytes([number]))
    lines = plan.of(traffic.BOARD)
    assert [plan.payloads[plan.payload[line]].datagram for line in lines] == [b"\1", b"\2", b"\3"]
    assert [*plan.due[lines]] == [100_000_000, 200_000_000, 1_500_000_000]
    assert len(plan.of(traffic.TELEMETRY)) == 2000


def test_each_datagram_of_the_load_has_room_for_a_number() -> None:
    heads: traffic.Numbers = np.zeros((len(datagrams(PAYLOADS)) + 1, 48), dtype=np.uint8)
    for number, (_, datagram) in enumerate(datagrams(PAYLOADS)):
        at = traffic.FLOAT_AT[datagram[0]]
        numbered = datagram[:at] + np.float32(1000 + number).tobytes() + datagram[at + 4 :]
        heads[number] = np.frombuffer(numbered.ljust(48, b"\0")[:48], dtype=np.uint8)
    assert [*traffic.numbers(heads)] == [*range(1000, 1000 + len(heads) - 1), -1]


def test_what_came_late_twice_or_not_at_all() -> None:
    sent, lines = np.array([10, 20, 30, 0, 50]), np.array([0, 1, 3, 4])
    number, at = np.array([100, 101, 101, 102, 7]), np.array([15, 120, 130, 31, 8])
    found = traffic.passage(sent, lines, 100, number, at)
    assert [*found.latency] == [5, 100]
    assert (found.lost, found.doubled) == (1, 1)  # what could not be sent is not lost


def brakes(*at: int) -> list[Command]:
    return [Command(each, None) for each in at]


@pytest.mark.parametrize(
    ("arrived", "found"),
    [
        (
            [Command(101, 1), Command(201, 2), *brakes(703, 803), Command(2001, 3), Command(2102, 4), *brakes(2611)],
            Braking(late=[3, 11], missing=0, old=0, lost=0),
        ),
        (
            [Command(101, 1), Command(201, 2), Command(2001, 3), Command(2101, 4), *brakes(2600)],
            Braking(late=[1300, 0], missing=1, old=0, lost=0),
        ),
        (
            [Command(101, 1), *brakes(600), Command(900, 2), *brakes(1400), Command(2001, 3), *brakes(2090, 2190)],
            Braking(late=[700, -410], missing=0, old=1, lost=1),
        ),
        ([], Braking(late=[1300, 1400], missing=2, old=0, lost=4)),
    ],
    ids=["good", "no brake", "an old command behind a brake", "nothing"],
)
def test_a_brake_is_as_late_as_it_comes_behind_the_timeout(arrived: list[Command], found: Braking) -> None:
    assert traffic.braking(SENT, arrived, TIMEOUT, MOST_AGE, END) == found


def test_quantiles_are_values_that_there_were() -> None:
    assert quantiles([3.0, 1.0, 2.0], {"p50": 0.5, "max": 1.0}) == {"p50": 2.0, "max": 3.0}
    assert quantiles([], {"p50": 0.5}) == {}


def rounds(p99: float, brake: float = 1.0, missing: float = 0, invalid: tuple[str, ...] = ()) -> list[Round]:
    metrics = {"udp_p99_us": p99, "brake_udp_max_ms": brake, "brakes_missing": missing}
    return [Round(metrics, {}, invalid), Round(metrics, {}, ())]


@pytest.mark.parametrize(
    ("pressure", "pressed", "missed"),
    [
        ("http", rounds(1000), []),
        ("http", rounds(1100), ["p99 2.20 of alone"]),
        ("http", rounds(1000, brake=11), ["brake_udp_max_ms 11.0"]),
        ("busy", rounds(900, brake=50), []),
        ("busy", rounds(1100, brake=51), ["brake_udp_max_ms 51.0", "p99 1.10 of the other"]),
        ("alone", rounds(5000, missing=1), ["1 without a brake"]),
    ],
)
def test_what_is_missed_depends_on_the_pressure(pressure: str, pressed: list[Round], missed: list[str]) -> None:
    assert row(pressure, pressed, rounds(500), rounds(1000)).missed == missed


def test_a_slow_router_is_slow_also_where_it_is_as_slow_alone() -> None:
    assert row("http", rounds(2100), rounds(2000)).missed == ["p99 2100 us"]


def test_one_invalid_round_makes_all_void() -> None:
    found = row("http", rounds(1000, invalid=("no pressure",)), rounds(500))
    assert verdict(found) == "INVALID: no pressure"
    assert "INVALID" in text("router", {"http": found})


def test_what_was_not_measured_is_not_judged() -> None:
    assert row("http", [Round({"cpu_us": 3.0}, {}, ())]) == Row({"cpu_us": Spread(3, 3, 3)}, None, None, [], [])


@pytest.mark.parametrize("is_changed", [False, True])
@pytest.mark.parametrize("pressure", ["", "images"])
def test_tables_have_no_errors_and_loopback_addresses_alone(tmp_path: Path, pressure: str, is_changed: bool) -> None:
    place = Place.free(tmp_path / "place")
    place.table.write_text(tables.table(place, pressure, is_changed), encoding="utf-8")
    found = check_table(place.table)  # `networks` makes any other address an error
    assert not found.diagnostics
    assert found.table is not None
    assert found.table.networks is not None
    assert [*map(str, found.table.networks.members)] == ["127.0.0.0/8"]


def test_what_is_sent_straight_to_the_receiver_all_comes(tmp_path: Path) -> None:
    build(tmp_path)
    to, log = f"127.0.0.1:{free_port()}", tmp_path / "arrivals"
    noise = random.Random(1)
    plan = traffic.telemetry([datagram for _, datagram in datagrams(PAYLOADS)], 2000, 0.1, noise)
    plan = Plan([*plan.payloads, Payload(1, 0, b"command")], plan.due, plan.payload)
    payloads, path = plan.write(tmp_path)
    receiving = [str(tmp_path / "receive"), "--listen", to, "--log", str(log)]
    with subprocess.Popen(receiving, stdout=subprocess.PIPE) as receiver:
        assert receiver.stdout is not None
        receiver.stdout.readline()
        sending = [tmp_path / "send", "--to", to, "--from", "127.0.0.1:0", "--from", "127.0.0.1:0", "--first", "77"]
        sending += ["--payloads", payloads, "--plan", path, "--log", tmp_path / "sent"]
        subprocess.run([*map(str, sending)], check=True, stdout=subprocess.DEVNULL)
        receiver.send_signal(signal.SIGTERM)
        receiver.stdout.read()
    sent: Any = np.fromfile(tmp_path / "sent", dtype="<i8")
    arrivals: Any = np.fromfile(log, dtype=traffic.ARRIVAL)
    found = traffic.passage(sent, np.arange(200), 77, traffic.numbers(arrivals["head"]), arrivals["at"])
    assert (len(found.latency), found.lost, found.doubled) == (200, 0, 0)
    assert (found.latency >= 0).all()
