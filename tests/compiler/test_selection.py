"""Which topics a gateway sends, and how often."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.selection import TopicSelector, is_hidden, pattern_problem
from router.errors import Located, SourceSpan
from router.table.model.gateways import EACH, Gateway, GatewayFormat, TopicPattern, TopicRate, Transport

SPAN = SourceSpan("table.yaml", 1, 1, 2)
GATEWAY = Gateway("it", SPAN, Located(Transport.UDP, SPAN), None, None, GatewayFormat.GATEWAY_V1)


NO_RATES: Mapping[str, int] = {}


def pattern(text: str) -> TopicPattern:
    """A glob, or with `re:` in front a regular expression."""
    return TopicPattern(text.removeprefix("re:"), text.startswith("re:"), SPAN)


def selector(
    include: Sequence[str] = (),
    exclude: Sequence[str] = (),
    inbound: Sequence[str] = (),
    rates: Mapping[str, int] = NO_RATES,
) -> TopicSelector:
    settings = replace(
        GATEWAY,
        include=tuple(map(pattern, include)),
        exclude=tuple(map(pattern, exclude)),
        rates=tuple(TopicRate(pattern(text), period) for text, period in rates.items()),
    )
    return TopicSelector(settings, inbound)


@pytest.mark.parametrize(
    ("glob", "topic", "is_match"),
    [
        ("/imu", "/imu", True),
        ("/imu", "/imu/data", False),
        ("/imu", "/imus", False),
        ("/imu", "/a/imu", False),
        ("/imu/*", "/imu/data", True),
        ("/imu/*", "/imu", False),
        ("/imu/*", "/imu/data/raw", False),
        ("/imu*", "/imu", True),
        ("/imu*", "/imu_2", True),
        ("/imu*", "/imu/data", False),
        ("/*_raw", "/imu_raw", True),
        ("/*/data", "/imu/data", True),
        ("/*/data", "/a/imu/data", False),
        ("/i?u", "/imu", True),
        ("/i?u", "/iu", False),
        ("/a?b", "/a/b", False),
        ("/a/**", "/a/b", True),
        ("/a/**", "/a/b/c", True),
        ("/a/**", "/a", False),
        ("/a/**", "/ab/c", False),
        ("/**/imu", "/imu", True),
        ("/**/imu", "/a/b/imu", True),
        ("/**/imu", "/a/b_imu", False),
        ("/a/**/d", "/a/d", True),
        ("/a/**/d", "/a/b/c/d", True),
        ("/a/**/*", "/a/b", True),
        ("/**", "/anything/at/all", True),
        ("re:/imu/.*", "/imu/data/raw", True),
        ("re:/imu", "/imu/data", False),
        ("re:.*data", "/imu/data", True),
        ("re:/(a|b)", "/b", True),
        ("re:/a|/b", "/b", True),
        ("re:/a|/b", "/a/b", False),
        ("/IMU", "/imu", False),
    ],
)
def test_patterns_match_whole_names(glob: str, topic: str, is_match: bool) -> None:
    assert selector([glob]).selects(topic) is is_match


NAME = st.lists(st.text("ab_1", min_size=1, max_size=3), min_size=1, max_size=4).map(
    lambda parts: "/" + "/".join(parts)
)


@given(NAME, st.text("ab*?", min_size=1, max_size=4).filter(lambda glob: "**" not in glob))
def test_within_one_part_globs_are_those_of_a_shell(name: str, glob: str) -> None:
    expected = name.count("/") == 1 and fnmatch.fnmatchcase(name[1:], glob) and not is_hidden(name)
    assert selector([f"/{glob}"]).selects(name) is expected


@given(NAME)
def test_a_name_matches_itself_also_where_it_is_hidden(name: str) -> None:
    assert selector([name]).selects(name)


def test_without_an_include_every_topic_is_sent_that_is_not_hidden() -> None:
    everything = selector()
    assert everything.selects("/a")
    assert everything.selects("/a/b/c")
    assert everything.selects("/rosout")
    assert everything.selects("/parameter_events")
    assert not everything.selects("/navigate/_action/feedback")


@pytest.mark.parametrize("include", ["/**", "/a/_b*", "/a/_?", "re:/a/_b"])
def test_hidden_topics_are_not_matched_by_what_is_no_name(include: str) -> None:
    assert not selector([include]).selects("/a/_b")


def test_an_exclude_wins_also_over_the_very_name() -> None:
    assert not selector(["/a", "/**"], ["/a"]).selects("/a")
    assert not selector([], ["re:/camera/.*"]).selects("/camera/raw")
    assert selector([], ["/camera/*"]).selects("/camera/raw/compressed")


def test_what_clients_publish_goes_back_to_them_under_its_very_name_only() -> None:
    assert not selector([], inbound=["/cmd_vel"]).selects("/cmd_vel")
    assert not selector(["/*", "re:/cmd_vel"], inbound=["/cmd_vel"]).selects("/cmd_vel")
    assert selector(["/*", "/cmd_vel"], inbound=["/cmd_vel"]).selects("/cmd_vel")


def test_the_first_pattern_that_includes_a_topic_is_known() -> None:
    chosen = selector(["/b", "/a/*", "/**"]).chosen_by("/a/b")
    assert chosen
    assert chosen.text == "/a/*"
    anything = selector().chosen_by("/a")
    assert anything
    assert anything.text == "/**"
    assert selector(["/b"]).chosen_by("/a") is None


def test_the_first_rate_that_matches_counts_and_others_have_the_publish_period() -> None:
    rates = selector(rates={"/a/imu": 20, "/a/**": EACH, "/a/b": 7})
    assert [rates.period(topic) for topic in ("/a/imu", "/a/b", "/b")] == [20, EACH, GATEWAY.publish_period]
    rated = rates.rated_by("/a/b")
    assert rated
    assert rated.text == "/a/**"
    assert rates.rated_by("/b") is None


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("imu", "does not begin with '/'"),
        ("**/imu", "does not begin with '/'"),
        ("/", "one of its parts is empty"),
        ("/a/", "one of its parts is empty"),
        ("//a", "one of its parts is empty"),
        ("/a**", "'a**' is not a valid part"),
        ("/***", "'***' is not a valid part"),
        ("/[ab]", "'[ab]' is not a valid part"),
        ("/{a,b}", "is not a valid part"),
        ("/a b", "'a b' is not a valid part"),
        ("/ä", "'ä' is not a valid part"),
        ("/a\n", "is not a valid part"),
        ("re:(", "is not a regular expression"),
        ("re:*", "is not a regular expression"),
        ("re:a{99999999999999999999}", "is not a regular expression"),
        pytest.param(f"re:{'(' * 9000}{')' * 9000}", "is not a regular expression", id="deep"),
    ],
)
def test_what_is_no_pattern_is_said(text: str, what: str) -> None:
    problem = pattern_problem(pattern(text))
    assert problem
    assert what in problem.what


@pytest.mark.parametrize("regex", ["^/imu.*$", r"\A/imu.*\Z", "(?P<name>/imu).*", "/im[u].*", "(?!/camera).*imu.*"])
def test_what_says_that_the_whole_name_is_meant_changes_nothing(regex: str) -> None:
    chosen = selector([f"re:{regex}"])
    assert chosen.selects("/imu_2")
    assert not chosen.selects("/camera/imu_2")
    assert not chosen.selects("/im")


@pytest.mark.parametrize(
    "text", ["/a", "/a/**/b*", "/*", f"re:{'(' * 200}{')' * 200}", "/?", "/**", "/_hidden", "/*_*", "re:.*", "re:imu"]
)
def test_what_is_a_pattern_has_no_problem(text: str) -> None:
    assert pattern_problem(pattern(text)) is None
