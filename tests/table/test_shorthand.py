from __future__ import annotations

from pathlib import Path

import pytest

from router.errors import Code
from router.table.keys import are_same
from router.table.model import RouteTable
from tests.table.tables import SMALL, good, parts, places

ENDPOINTS = """
endpoints:
  arm: {address: 10.0.0.1:8, kind: board}
  base: {address: 10.0.0.2:8, kind: basestation}
"""


def table(folder: Path, routes: str, defaults: str = "{}") -> RouteTable:
    head = SMALL.replace("routes: {}\n", "")
    return good(folder, f"{head}{ENDPOINTS}defaults: {defaults}\nroutes:\n{routes}")


TO_BOTH = "{timeout: 1s, send: {x: {}}, to: [arm, base], disarmed_by: [y]}"


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ("{source: arm, topic: a}", "{source: [arm], topics: [{topic: a}]}"),
        ("{source: arm, topic: {topic: a, queue_depth: 3}}", "{source: arm, topics: [{topic: a, queue_depth: 3}]}"),
        ("{source: arm, topics: a}", "{source: arm, topics: [{topic: a}]}"),
        ("{source: arm, topics: [a, {topic: b}]}", "{source: arm, topics: [{topic: a}, {topic: b}]}"),
        ("{source: arm, destinations: base}", "{source: [arm], destinations: [{endpoint: base}]}"),
        ("{source: arm, reply: {pong: {id: id}}}", "{source: arm, reply: {case: pong, fields: {id: id}}}"),
        ("{source: arm, reply: {pong: auto}}", "{source: arm, reply: {case: pong, fields: auto}}"),
        ("{source: arm, reply: {pong: {}}}", "{source: arm, reply: {case: pong, fields: {}}}"),
        ("{source: {topic: a}, destinations: base}", "{source: [{topic: a}], destinations: [base]}"),
        (
            "{source: arm, topic: {topic: a, qos: sensor_data}}",
            "{source: arm, topics: [{topic: a, qos: {profile: sensor_data}}]}",
        ),
        (
            "{source: base, destinations: [arm, base], deadman: {timeout: 1s, send: {x: {}}, disarmed_by: y}}",
            "{source: base, destinations: [arm, base], deadman: " + TO_BOTH + "}",
        ),
        (
            "{source: base, destinations: arm, deadman: {timeout: 1s, send: {x: {}}, to: base}}",
            "{source: base, destinations: arm, deadman: {timeout: 1s, send: {x: {}}, to: [base]}}",
        ),
    ],
)
def test_a_short_form_is_the_long_one(tmp_path: Path, short: str, long: str) -> None:
    assert are_same(table(tmp_path, f"  it: {short}\n").routes, table(tmp_path, f"  it: {long}\n").routes)


DEFAULTS = "{queue_depth: 7, ttl: 2s, deadman: {timeout: 1s, repeat: 50ms}}"


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ("{source: arm, topic: a}", "{source: arm, ttl: 2s, topic: {topic: a, queue_depth: 7}}"),
        ("{source: arm, ttl: 1s, topic: a}", "{source: arm, ttl: 1s, topic: {topic: a, queue_depth: 7}}"),
        (
            "{source: arm, ttl: {none: why}, topic: a}",
            "{source: arm, ttl: {none: why}, topic: {topic: a, queue_depth: 7}}",
        ),
        (
            "{source: arm, topic: {topic: a, queue_depth: 3}}",
            "{source: arm, ttl: 2s, topic: {topic: a, queue_depth: 3}}",
        ),
        (
            "{source: arm, topic: {topic: a, qos: sensor_data}}",  # whose depth is its own
            "{source: arm, ttl: 2s, topic: {topic: a, qos: sensor_data}}",
        ),
        (
            "[{source: {topic: a}, destinations: base}]",
            "[{source: {topic: a, queue_depth: 7}, ttl: 2s, destinations: base}]",
        ),
        (
            "{source: base, destinations: arm, deadman: {send: {x: {}}}}",
            "{source: base, destinations: arm, ttl: 2s, deadman: {timeout: 1s, repeat: 50ms, send: {x: {}}}}",
        ),
        (
            "{source: base, destinations: arm, deadman: {timeout: 3s, send: {x: {}}}}",
            "{source: base, destinations: arm, ttl: 2s, deadman: {timeout: 3s, repeat: 50ms, send: {x: {}}}}",
        ),
        (
            "{source: base, destinations: arm, deadman: {none: it stops by itself}}",
            "{source: base, destinations: arm, ttl: 2s, deadman: {none: it stops by itself}}",
        ),
        ("{ignore: why}", "{ignore: why}"),
    ],
)
def test_defaults_are_for_what_says_nothing_of_its_own(tmp_path: Path, short: str, long: str) -> None:
    with_defaults = table(tmp_path, f"  it: {short}\n", DEFAULTS)
    assert are_same(with_defaults.routes, table(tmp_path, f"  it: {long}\n").routes)


def test_a_default_qos_is_for_topics_without_one_and_gives_way_to_a_depth(tmp_path: Path) -> None:
    defaults = "{qos: {profile: sensor_data, depth: 9}}"
    topics = "[a, {topic: b, queue_depth: 3}, {topic: c, qos: {depth: 1}}]"
    long = (
        "[{topic: a, qos: {profile: sensor_data, depth: 9}}, {topic: b, queue_depth: 3, qos: sensor_data},"
        " {topic: c, qos: {depth: 1}}]"
    )
    short_one = table(tmp_path, f"  it: {{source: arm, topics: {topics}}}\n", defaults)
    assert are_same(short_one.routes, table(tmp_path, f"  it: {{source: arm, topics: {long}}}\n").routes)


def test_topics_of_clients_have_the_defaults_of_topics_and_deadmen(tmp_path: Path) -> None:
    text = (
        f"{SMALL}defaults: {DEFAULTS}\ngateways:\n  page:\n    transport: {{websocket: 127.0.0.1:8765}}\n"
        "    inbound: [{topic: /a, type: std_msgs/msg/Bool, deadman: {send: {}}}]\n"
    )
    [inbound] = good(tmp_path, text).gateways["page"].inbound
    assert inbound.deadman
    assert inbound.topic.queue_depth
    assert (inbound.topic.queue_depth.value, inbound.deadman.timeout.value) == (7, 10**9)


def test_defaults_merge_with_those_of_the_extended_table(tmp_path: Path) -> None:
    head = SMALL.replace("routes: {}\n", "")
    (tmp_path / "base.yaml").write_text(
        f"{head}{ENDPOINTS}defaults: {{queue_depth: 7, ttl: 2s}}\nroutes: {{it: {{source: arm, topic: a}}}}\n"
    )
    [route] = good(tmp_path, "extends: base.yaml\ndefaults: {queue_depth: 8}\n").routes
    assert route.ttl
    assert route.topics[0].queue_depth
    assert (route.ttl.value, route.topics[0].queue_depth.value) == (2 * 10**9, 8)


def test_topic_and_topics_replace_each_other_in_a_table_that_extends(tmp_path: Path) -> None:
    head = SMALL.replace("routes: {}\n", "")
    (tmp_path / "base.yaml").write_text(
        f"{head}{ENDPOINTS}routes: {{it: {{source: arm, topic: a}}, other: {{source: arm, topics: [a]}}}}\n"
    )
    text = "extends: base.yaml\nroutes: {it: {topics: [b, c]}, other: {topic: d}}\n"
    names = [[topic.topic.value for topic in route.topics] for route in good(tmp_path, text).routes]
    assert names == [["b", "c"], ["d"]]


def test_a_bad_default_is_one_finding_where_it_stands(tmp_path: Path) -> None:
    head = SMALL.replace("routes: {}\n", "")
    routes = "  one: {source: arm, topic: a}\n  two: {source: arm, topic: b}\n"
    text = f"{head}defaults: {{queue_depth: none, ttl: 2s}}{ENDPOINTS}routes:\n{routes}"
    found, findings = parts(tmp_path, text)
    assert places(findings) == [(Code.WRONG_TYPE, 4, 25)]
    assert [(route.ttl is not None, route.topics[0].queue_depth) for route in found.routes] == [(True, None)] * 2
