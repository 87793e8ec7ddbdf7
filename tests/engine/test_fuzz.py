"""The fuzzer of benchmarks/ in short: damaged datagrams by the thousand raise nothing and are all accounted for."""

from __future__ import annotations

from benchmarks.fuzz_engine import fuzz
from router.compiler.metrics import REJECT_REASONS


def test_damaged_datagrams_are_counted_and_nothing_else() -> None:
    outcome = fuzz(50_000, seed=7)
    assert outcome.findings == []
    assert outcome.fates["accepted"] > 5_000
    unheard_of = [reason for reason in REJECT_REASONS if not outcome.fates[f"rejected {reason}"]]
    assert unheard_of == ["ignored"], "the rover ignores nothing; all else should have happened"
