"""Random mappings and conditions by the million, on random messages: the carrier gives what the oracle gives.

    python -m benchmarks.judge_language --count 1000000 --seed 1

Counts messages. Prints the shortest mapping of each disagreement, findings that are not about ranges, and exceptions;
exits 1 if there are any.
"""

from __future__ import annotations

import argparse
import random
import sys
import traceback
from collections import Counter
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from router.carrier.build import build
from tests.carrier.answering import carrier_plane
from tests.carrier.delivering import delivering
from tests.compiler.judging import Misfit, Plane, disagreement, is_about_values, question
from tests.compiler.language import some_language


@cache
def carrier() -> Plane:
    folder = Path(mkdtemp())
    return carrier_plane(delivering(folder / "delivering.so", build(folder / "libcarrier.so"), is_sanitized=False))


MESSAGES = 10
"""Of each mapping."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--wild", action="store_true", help="expressions that are not well-typed as well")
    parser.add_argument("--stop", type=int, default=20, help="end after so many kinds of problems")
    arguments = parser.parse_args()
    outcomes: Counter[str] = Counter()
    problems: dict[str, str] = {}
    for number in range(arguments.count // MESSAGES):
        noise = random.Random(f"{arguments.seed} {number}")
        asked = question(noise, some_language(noise, is_wild=arguments.wild))
        try:
            found = disagreement(asked, carrier(), noise)
            outcomes["judged" if found is None else "disagreed"] += 1
            if found is not None:
                _keep(problems, f"disagreement {number}", found)
        except Misfit as misfit:
            outcomes["refused"] += 1
            for finding in misfit.findings:
                if not arguments.wild and not is_about_values(finding):
                    _keep(problems, f"{finding.code.value}: {finding.message}", f"{asked}\n  {finding}")
        except Exception as error:  # noqa: BLE001 - whatever it is, it is reported
            outcomes["raised"] += 1
            place = traceback.extract_tb(error.__traceback__)[-1]
            _keep(problems, f"{type(error).__name__} in {place.filename}:{place.lineno}", f"{asked}\n  {error!r}")
        if len(problems) >= arguments.stop:
            break
    for problem, example in sorted(problems.items(), key=lambda each: len(each[1])):
        print(f"{problem}\n  {example}\n")
    print(", ".join(f"{count} {outcome}" for outcome, count in outcomes.items()))
    return 1 if problems else 0


def _keep(problems: dict[str, str], problem: str, example: str) -> None:
    if len(example) < len(problems.get(problem, example + " ")):
        problems[problem] = example


if __name__ == "__main__":
    sys.exit(main())
