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
PAGE = ROOT / "docs/troubleshooting/alerts.md"
SECTIONS = re.findall(r"^## (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
CONFIGURATION = yaml.safe_load((FOLDER / "prometheus.yml").read_text(encoding="utf-8"))
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


@pytest.mark.parametrize("name", ALERTS)
def test_the_runbook_of_an_alert_is_the_section_of_its_name(name: str) -> None:
    url = re.fullmatch(
        r"\{\{ \$externalLabels\.(\w+) \}\}/(.+)\.html#(\w+)", ALERTS[name]["annotations"]["runbook_url"]
    )
    assert url
    label, path, anchor = url.groups()
    assert label in CONFIGURATION["global"]["external_labels"]
    assert ROOT / "docs" / f"{path}.md" == PAGE
    assert anchor in {section.lower() for section in SECTIONS}  # the anchor that code hosts and MyST give to one word
    assert anchor == name.lower()


def test_the_documentation_is_found_where_links_are_put_together() -> None:
    assert re.fullmatch(r"https?://.*[^/]", CONFIGURATION["global"]["external_labels"]["docs"])


def test_the_page_has_one_section_for_each_alert_that_there_is() -> None:
    assert sorted(SECTIONS) == sorted(ALERTS)
