"""deploy/prometheus: rules and alerts that Prometheus takes, that are tested, named as they should be and explained."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.deploy.promql import selectors

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "deploy/prometheus"
PAGE = ROOT / "docs/guides/monitor.md"
TESTS = sorted((FOLDER / "tests").glob("*.yml"))
PROMTOOL = shutil.which("promtool")
LEVELS = ("instance", "listener", "route", "endpoint", "destination", "topic", "target", "reason", "le")

promtool = pytest.mark.skipif(PROMTOOL is None, reason="promtool is not installed; it comes with Debian's prometheus")


def rules(file: str) -> list[dict[str, Any]]:
    groups = yaml.safe_load((FOLDER / file).read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


RECORDED = {rule["record"]: rule["expr"] for rule in rules("rules.yml")}
ALERTS = {rule["alert"]: rule for rule in rules("alerts.yml")}


def told(*arguments: object) -> str:
    assert PROMTOOL
    ran = subprocess.run(
        [PROMTOOL, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout
    return ran.stdout


@promtool
def test_prometheus_takes_the_configuration_with_all_rules() -> None:
    said = told("check", "config", FOLDER / "prometheus.yml")
    assert f"{len(RECORDED)} rules found" in said
    assert f"{len(ALERTS)} rules found" in said


@promtool
def test_rules_and_alerts_do_what_their_tests_say() -> None:
    told("test", "rules", *TESTS)


def test_each_alert_is_tested_firing_and_not_firing() -> None:
    cases = [
        case
        for test in TESTS
        for each in yaml.safe_load(test.read_text())["tests"]
        for case in each.get("alert_rule_test", ())
    ]
    assert {case["alertname"] for case in cases if case.get("exp_alerts")} == set(ALERTS)
    assert {case["alertname"] for case in cases if not case.get("exp_alerts")} == set(ALERTS)


@pytest.mark.parametrize("name", RECORDED)
def test_recording_rules_are_named_level_metric_operations(name: str) -> None:
    level, metric, operations = name.split(":")
    assert set(level.split("_")) <= set(LEVELS)
    assert re.fullmatch(r"router_[a-z_]+", metric)
    assert not metric.endswith("_total")
    assert re.fullmatch(r"(p\d\d_|mean_)?rate1m|last1h", operations)


@pytest.mark.parametrize("name", [*RECORDED, *ALERTS])
def test_what_rules_ask_of_each_other_is_recorded(name: str) -> None:
    expression = RECORDED.get(name) or ALERTS[name]["expr"]
    asked = {selector.metric for selector in selectors(expression)}
    assert asked
    assert {metric for metric in asked if ":" in metric} <= set(RECORDED)


@pytest.mark.parametrize("name", ALERTS)
def test_an_alert_says_how_bad_it_is_what_it_is_and_where_to_read_on(name: str) -> None:
    alert = ALERTS[name]
    assert alert["labels"]["severity"] in ("critical", "warning", "info")
    assert set(alert["annotations"]) == {"summary", "runbook_url"}
    assert alert["annotations"]["runbook_url"] == f"{{{{ $externalLabels.docs }}}}/guides/monitor.md#{name.lower()}"
    assert f"\n### {name}\n" in PAGE.read_text()


def test_the_page_explains_no_alert_that_there_is_not() -> None:
    explained = set(re.findall(r"^### (\w+)$", PAGE.read_text(), re.MULTILINE))
    assert explained == set(ALERTS)
