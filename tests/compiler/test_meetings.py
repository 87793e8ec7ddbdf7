"""Routes that meet: at a source, and on a topic."""

from __future__ import annotations

import pytest

from router.errors import Code
from tests.compiler.conftest import CheckText

ENDPOINTS = (
    "{one: {address: 127.0.0.2:8, kind: tool}, two: {address: 127.0.0.3:8, kind: tool},"
    " three: {address: 127.0.0.4:8, kind: tool}}"
)
HOST = "{source: %s, destinations: [three]}"
TOPIC = "{source: ros, topics: [{topic: %s, type: std_msgs/msg/Float32}], fields: {ph_value: data}, destinations: [%s]}"
PUBLISHED = "{source: %s, topics: [{topic: %s, type: std_msgs/msg/Float32, fields: {data: ph_value}}]}"


def codes(check_text: CheckText, *routes: str) -> list[Code]:
    text = f"routes: {{ph_info: [{', '.join(routes)}]}}"
    found = check_text(text, endpoints=ENDPOINTS).diagnostics
    return [finding.code for finding in found if finding.code is not Code.UNCOVERED_PAYLOAD_CASE]


@pytest.mark.parametrize(
    ("first", "second", "is_clash"),
    [
        ("one", "two", False),
        ("one", "one", True),
        ("[one, two]", "two", True),
        ("any", "two", True),
        ("one", "any", True),
        ("any", "any", True),
    ],
)
def test_a_source_belongs_to_one_route_of_a_case(
    check_text: CheckText, first: str, second: str, is_clash: bool
) -> None:
    assert codes(check_text, HOST % first, HOST % second) == [Code.SOURCE_CLASH] * is_clash


@pytest.mark.parametrize(
    ("first", "second", "is_clash"), [("a", "b", False), ("a", "a", True), ("a", "/a", True), ("a", "~/a", False)]
)
def test_a_topic_feeds_one_route_of_a_case(check_text: CheckText, first: str, second: str, is_clash: bool) -> None:
    assert codes(check_text, TOPIC % (first, "one"), TOPIC % (second, "two")) == [Code.SOURCE_CLASH] * is_clash


def test_ros_is_no_part_of_any(check_text: CheckText) -> None:
    assert codes(check_text, HOST % "any", TOPIC % ("a", "three")) == []


@pytest.mark.parametrize(
    ("source", "published", "heard", "destination", "is_loop"),
    [
        ("one", "a", "a", "two", False),
        ("one", "a", "a", "one", True),
        ("[one, two]", "a", "/a", "two", True),
        ("one", "a", "b", "one", False),
    ],
)
def test_nobody_gets_back_through_a_topic_what_he_sent(
    check_text: CheckText, source: str, published: str, heard: str, destination: str, is_loop: bool
) -> None:
    found = codes(check_text, PUBLISHED % (source, published), TOPIC % (heard, destination))
    assert found == [Code.FORWARDING_LOOP] * is_loop
