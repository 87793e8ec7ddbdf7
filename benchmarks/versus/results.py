"""The file of results: written and merged. Says which machine a scenario was measured on, not what figures mean."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from benchmarks.versus.building import ROOT
from benchmarks.versus.figures import Judged, spreads
from benchmarks.versus.processes import read
from benchmarks.versus.scenarios import SCENARIOS, Scenario
from benchmarks.versus.trial import Metrics

DEFAULT = ROOT / "benchmarks" / "results.json"


def machine() -> dict[str, Any]:
    """What figures depend on. Names neither the computer nor a path."""
    lines = (line.partition(":") for line in read("/proc/cpuinfo").splitlines())
    model = next((value.strip() for key, _, value in lines if key.strip() == "model name"), platform.machine())
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "kernel": platform.release(),
        "python": platform.python_version(),
    }


def commit() -> str:
    """Of this checkout, `+` if it has changes; empty where it is none."""
    words = ["git", "describe", "--always", "--dirty=+"]
    described = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    return described.stdout.strip()


def entry(
    scenario: Scenario, rounds: Mapping[str, Sequence[Metrics]], judged: Sequence[Judged], seconds: float
) -> dict[str, Any]:
    """What the file says of one scenario."""
    return {
        "title": scenario.title,
        "machine": machine(),
        "date": datetime.now(timezone.utc).date().isoformat(),
        "commit": commit(),
        "repeat": len(next(iter(rounds.values()))),
        "seconds": seconds,
        "contenders": {
            name: {metric: value._asdict() for metric, value in spreads(of_one).items()}
            for name, of_one in rounds.items()
        },
        "figures": [
            {
                "metric": aim.metric,
                "against": aim.against,
                **value._asdict(),
                "aim": aim.text(),
                "verdict": verdict,
            }
            for aim, value, verdict in judged
        ],
    }


def empty() -> dict[str, Any]:
    """Results without any scenario yet."""
    return {"scenarios": {}}


def load(path: Path) -> dict[str, Any]:
    """What a file has, if there is one."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else empty()


def merge(results: dict[str, Any], name: str, entry: Mapping[str, Any]) -> None:
    """Puts a scenario in the place of what was there of it; the others stay, in the order of their definition."""
    found = {**results["scenarios"], name: entry}
    results["scenarios"] = {scenario.name: found[scenario.name] for scenario in SCENARIOS if scenario.name in found}


def store(path: Path, results: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
