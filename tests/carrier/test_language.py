"""The language on the carrier: what the oracle gives, from UDP and from ROS.

`python -m benchmarks.judge_language` tries many more expressions.
"""

from __future__ import annotations

import random
from ctypes import CDLL

from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from tests.carrier.answering import carrier_plane
from tests.compiler.judging import is_about_values, judged_findings, question
from tests.compiler.language import some_language

MANY = settings(max_examples=10 * settings().max_examples, suppress_health_check=list(HealthCheck))
noises = st.integers(0, (1 << 64) - 1).map(random.Random)
"""They do not shrink, but there can be many of them."""


@MANY
@given(noises)
def test_mappings_give_what_the_oracle_gives(delivering: CDLL, noise: random.Random) -> None:
    asked = question(noise, some_language(noise))
    findings = judged_findings(asked, carrier_plane(delivering), noise)
    assert all(map(is_about_values, findings)), (str(asked), [*map(str, findings)])
    event("refused" if findings else "judged")


@MANY
@given(noises)
def test_what_is_ill_typed_is_a_finding_and_the_rest_is_right(delivering: CDLL, noise: random.Random) -> None:
    asked = question(noise, some_language(noise, is_wild=True))
    for finding in judged_findings(asked, carrier_plane(delivering), noise):
        assert finding.span.line == 7
