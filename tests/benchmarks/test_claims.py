"""The README shows a figure only if its measurement was fair."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.versus.claims import CLAIMS, NONE, Claim, table
from benchmarks.versus.figures import judge, spreads
from benchmarks.versus.scenarios import SCENARIOS
from benchmarks.versus.trial import Metrics

CPU = Claim("processor time", "peers_work", ("cpu_us@1000", "cpu_us@5000"), against_peer=True)
MEMORY = Claim("memory", "footprint_rover", ("rss_mb",), "MB", any_priority=True)
MACHINE = {"cpu": "EPYC", "cores": 2}
FAIR = {"copies": 2.0, "receive_buffer": 8e6, "realtime": 0.0}
AS_SERVICE = {**FAIR, "realtime": 1.0}
AIMS = {scenario.name: scenario.aims for scenario in SCENARIOS}


def entry(scenario: str, rounds: dict[str, Metrics], commit: str = "abc", date: str = "2026-11-28") -> dict[str, Any]:
    each = {name: [metrics] for name, metrics in rounds.items()}
    return {
        "commit": commit,
        "date": date,
        "machine": MACHINE,
        "contenders": {name: {k: v._asdict() for k, v in spreads(of_one).items()} for name, of_one in each.items()},
        "figures": [
            {"metric": aim.metric, "of": aim.of, "against": aim.against, **value._asdict(), "verdict": verdict}
            for aim, value, verdict in judge(AIMS[scenario], each)
        ],
    }


def cpu(router: Metrics, peer: Metrics, **others: Metrics) -> dict[str, Any]:
    taken = {"cpu_us@1000": 5.0, "cpu_us@5000": 4.0}
    peers = {"cpu_us@1000": 10.0, "cpu_us@5000": 5.0}
    rounds = {"router": {**taken, **router}, "peer": {**peers, **peer}}
    rounds |= {name: {**(taken if "router" in name else peers), **metrics} for name, metrics in others.items()}
    return entry("peers_work", rounds)


def shown(*claims: Claim, **scenarios: dict[str, Any]) -> list[str]:
    return [line for line in table({"scenarios": scenarios}, claims).splitlines() if "`" in line and line[0] == "|"]


def test_a_fair_comparison_is_shown_with_its_scenario_for_users_and_services() -> None:
    found = cpu(FAIR, FAIR, router_realtime=AS_SERVICE, peer_realtime=AS_SERVICE)
    assert shown(CPU, peers_work=found) == ["| processor time | x 0.50 and x 0.80 | x 0.50 and x 0.80 | `peers_work` |"]


def test_what_the_service_gets_is_not_measured_where_its_peer_was_an_ordinary_process() -> None:
    found = cpu(FAIR, FAIR, router_realtime=AS_SERVICE, peer_realtime=FAIR)
    assert shown(CPU, peers_work=found) == ["| processor time | x 0.50 and x 0.80 | not measured | `peers_work` |"]


@pytest.mark.parametrize(
    "found",
    [
        cpu({**FAIR, "copies": 1.0}, FAIR),
        cpu(FAIR, {**FAIR, "receive_buffer": 2e5}),
        cpu({**FAIR, "realtime": 1.0}, FAIR),
        cpu({}, {}),
        cpu({**FAIR, "lost@5000": 1.0}, FAIR),
        cpu(FAIR, {**FAIR, "noise": 0.2}),
    ],
    ids=["less work", "another buffer", "another priority", "unknown conditions", "lost datagrams", "disturbed"],
)
def test_an_unfair_or_void_comparison_is_left_out(found: dict[str, Any]) -> None:
    assert table({"scenarios": {"peers_work": found}}, [CPU]) == NONE


def memory(commit: str, date: str) -> dict[str, Any]:
    return entry("footprint_rover", {"router": {"rss_mb": 134.2}}, commit, date)


def test_a_figure_of_changed_files_is_left_out() -> None:
    assert table({"scenarios": {"footprint_rover": memory("abc+", "2026-11-28")}}, [MEMORY]) == NONE


def test_only_figures_of_the_newest_commit_are_shown() -> None:
    fair = cpu(FAIR, FAIR)
    assert [
        row.split("`")[1] for row in shown(CPU, MEMORY, peers_work=fair, footprint_rover=memory("abc", "2026-11-28"))
    ] == [
        "peers_work",
        "footprint_rover",
    ]
    assert shown(CPU, MEMORY, peers_work=fair, footprint_rover=memory("abd", "2026-11-29")) == [
        "| memory | 134 MB | 134 MB | `footprint_rover` |"
    ]


def test_what_is_claimed_is_measured() -> None:
    figures = {(name, aim.metric, aim.against) for name, aims in AIMS.items() for aim in aims}
    for claim in CLAIMS:
        if not claim.scenario.startswith("pressure_"):
            against = "peer" if claim.against_peer else None
            assert {(claim.scenario, metric, against) for metric in claim.metrics} <= figures


def test_the_readme_claims_at_most_five_things() -> None:
    assert len(CLAIMS) <= 5
