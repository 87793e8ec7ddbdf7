"""deploy/prometheus: rules and alerts that Prometheus takes, that are tested, named as they should be and explained."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from router.compiler.metrics import INTENDED_REASONS
from router.observe.problems import DROPS, Kind
from router.observe.problems import PAGE as HEALTH_PAGE
from tests.deploy.promql import selectors

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
FOLDER = ROOT / "deploy/prometheus"
PAGE = ROOT / HEALTH_PAGE
SECTIONS = dict(re.findall(r"^## (.*)\n\n(\w+):", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
"""The level by the name of the section."""
CONFIGURATION = yaml.safe_load((FOLDER / "prometheus.yml").read_text(encoding="utf-8"))
TESTS = sorted((FOLDER / "tests").glob("*.yml"))
PROMTOOL = shutil.which("promtool")
LEVELS = ("instance", "listener", "route", "endpoint", "destination", "topic", "target", "reason", "le")

NO_ALERT = {"ReceiveStuck", "CommandBurst", "Halted"}
"""No metric says so; scrapes are too rare to see it; a rover that nobody drives is well."""
OF_PROMETHEUS = {"RouterRestarting", "RouterBusy", "RouteSlow"}
"""Of minutes, or of the process as a whole, which the router itself does not watch."""

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
    assert re.fullmatch(r"(p\d\d_|mean_)?rate1m", operations)


@pytest.mark.parametrize("name", [*RECORDED, *ALERTS])
def test_what_rules_ask_of_each_other_is_recorded(name: str) -> None:
    expression = RECORDED.get(name) or ALERTS[name]["expr"]
    asked = {selector.metric for selector in selectors(expression)}
    assert asked
    assert {metric for metric in asked if ":" in metric} <= set(RECORDED)


def test_there_is_an_alert_for_each_kind_of_problem() -> None:
    assert ALERTS.keys() - OF_PROMETHEUS == {kind.alert for kind in Kind} - NO_ALERT


@pytest.mark.parametrize("kind", [kind for kind in Kind if kind.alert in ALERTS], ids=lambda kind: kind.alert)
def test_an_alert_has_words_level_metric_and_threshold_of_its_kind_of_problem(kind: Kind) -> None:
    alert = ALERTS[kind.alert]
    words = kind.words.format_map({label: f"{{{{ $labels.{label} }}}}" for label in kind.labels})
    assert alert["annotations"]["summary"].startswith(words)
    assert alert["labels"] == {"severity": kind.level.value}
    asked = [RECORDED.get(selector.metric, selector.metric) for selector in selectors(alert["expr"])]
    assert kind.metric in " ".join(asked)
    decides = alert["expr"].partition(" unless ")[0]
    compared = re.search(r"(?:>|==) (\S+)$", decides)
    if kind in (Kind.ENDPOINT_SILENT, Kind.ENDPOINT_NEVER_HEARD):
        assert decides.endswith("> on (job, instance, endpoint) router_endpoint_stale_after_seconds")
    else:
        assert compared
        assert float(compared[1]) == kind.threshold


@pytest.mark.parametrize("kind", [*DROPS, Kind.DATAGRAMS_REJECTED], ids=lambda kind: kind.alert)
def test_losses_that_the_table_asks_for_raise_no_alert(kind: Kind) -> None:
    selector, *_ = selectors(ALERTS[kind.alert]["expr"])
    command = str(kind is Kind.COMMANDS_DROPPED).lower()
    assert selector.selects(selector.metric, {"reason": "malformed", "command": command})
    assert not any(
        selector.selects(selector.metric, {"reason": reason, "command": command}) for reason in INTENDED_REASONS
    )


@pytest.mark.parametrize("name", ALERTS)
def test_an_alert_says_how_bad_it_is_what_it_is_and_where_to_read_on(name: str) -> None:
    assert ALERTS[name]["labels"]["severity"] == SECTIONS[name].lower()
    assert set(ALERTS[name]["annotations"]) == {"summary", "runbook_url"}


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


def test_the_page_has_one_section_for_each_kind_of_problem_and_alert_with_its_level() -> None:
    levels = {kind.alert: kind.level.value.capitalize() for kind in Kind}
    assert {name: level for name, level in SECTIONS.items() if name not in OF_PROMETHEUS} == levels
    assert SECTIONS.keys() >= OF_PROMETHEUS
