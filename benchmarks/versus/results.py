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
from benchmarks.versus.trial import Metrics

DEFAULT = ROOT / "benchmarks" / "results.json"


def machine() -> dict[str, Any]:
    """What figures depend on. Names neither the computer nor a path, nor the kernel's build: only its version."""
    lines = (line.partition(":") for line in read("/proc/cpuinfo").splitlines())
    model = next((value.strip() for key, _, value in lines if key.strip() == "model name"), platform.machine())
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "linux": ".".join(platform.release().split(".")[:2]),
        "python": platform.python_version(),
    }


def commit() -> str:
    """Of this checkout, `+` if anything but results has changed; empty where it is none."""

    def git(*words: str) -> str:
        command = ["git", *words]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()

    written = (f":!{DEFAULT.relative_to(ROOT)}", ":!docs/design/figures.md", ":!README.md")
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", *written)
    return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")


def entry(
    title: str, rounds: Mapping[str, Sequence[Metrics]], judged: Sequence[Judged], seconds: float
) -> dict[str, Any]:
    """What the file says of one scenario."""
    return {
        "title": title,
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
                "of": aim.of,
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
    """Puts a scenario in the place of what was there of it; the others stay."""
    results["scenarios"][name] = entry


def store(path: Path, results: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
