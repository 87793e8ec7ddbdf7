"""The reading of PromQL that the tests of rules and dashboards rest on."""

from __future__ import annotations

import pytest

from tests.deploy.promql import NotUnderstoodError, Selector, grouping_labels, selectors

ASKED = {
    "router_deadman_active == 1": [Selector("router_deadman_active")],
    'sum without (target) (rate(a_total{reason!="x,y}", route="r"}[1m])) > 0.05': [
        Selector("a_total", (("reason", "!=", "x,y}"), ("route", "=", "r")))
    ],
    "sum(rate(a[$__rate_interval])) by (le)": [Selector("a")],
    "timestamp(a) - (max_over_time(a[1h]) > 0)": [Selector("a"), Selector("a")],
    "level:metric:rate1m / on (instance, job) group_left (x) up": [Selector("level:metric:rate1m"), Selector("up")],
    "a > bool 1 or increase(b[5m]) offset 5m": [Selector("a"), Selector("b")],
    "time() - 1.5e3": [],
}


@pytest.mark.parametrize("expression", ASKED)
def test_the_series_that_an_expression_asks_for_are_found(expression: str) -> None:
    assert selectors(expression) == ASKED[expression]


def test_labels_by_which_is_grouped_are_found() -> None:
    expression = "sum by (le, route) (rate(a[1m])) / on (job) group_left (x) b"
    assert grouping_labels(expression) == {"le", "route", "job", "x"}


@pytest.mark.parametrize("expression", ['{job="a"}', "a{b}", "a{b=c}", "a{b=1}", 'a{b=="c"}', "a § b"])
def test_what_is_not_understood_is_refused(expression: str) -> None:
    with pytest.raises(NotUnderstoodError):
        selectors(expression)


@pytest.mark.parametrize(("sign", "value"), [("=", "stale"), ("!=", "x"), ("=~", "sta.*|x"), ("!~", "stal|x")])
def test_a_matcher_is_for_the_whole_value(sign: str, value: str) -> None:
    assert Selector("a", (("reason", sign, value), ("instance", "=", "added"))).selects("a", {"reason": "stale"})
    assert not Selector("a", (("reason", sign, value),)).selects("b", {"reason": "stale"})
