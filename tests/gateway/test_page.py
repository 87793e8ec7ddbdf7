"""The page of a websocket gateway, in a real browser, as a person uses it."""

from __future__ import annotations

import base64
import itertools
import json
import re
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.gateway.accessibility import (
    PHONE,
    SIZES,
    THEMES,
    contrast_problems,
    hidden_focus,
    overflows,
    show_at,
    small_targets,
    small_texts,
    unnamed_controls,
)
from tests.gateway.browser import Browser, Page
from tests.gateway.fake_gateway import MIXED, PAGE, FakeGateway, data_document, field, schema
from tests.gateway.pictures import IMAGE, TIMES, compressed_image, png, shown_pixel

pytestmark = pytest.mark.slow

HOSTILE = '<img src=x onerror="window.hacked=1">'


@pytest.fixture(scope="module")
def server() -> Iterator[FakeGateway]:
    """One for all tests: browsers hold a spare connection open, and closing a server waits for those."""
    running = FakeGateway()
    yield running
    running.close()


@pytest.fixture
def gateway(server: FakeGateway) -> FakeGateway:
    server.reset()
    return server


@pytest.fixture
def page(browser: Browser, gateway: FakeGateway) -> Iterator[Page]:
    """The page, connected. Whatever a test does with it, nothing in it may fail or break its policy."""
    opened = browser.open(gateway.url)
    opened.until("document.querySelector('#state').textContent === 'connected'")
    yield opened
    complaints = [text for text in opened.complaints() if "WebSocket connection" not in text]
    opened.close()
    assert complaints == []


def row(name: str) -> str:
    """JavaScript for the row of a topic; null if there is none."""
    is_it = f"row => row.querySelector('.name').title === {json.dumps(name)}"
    return f"([...document.querySelectorAll('tbody tr')].find({is_it}) ?? null)"


def choose(page: Page, name: str) -> None:
    page.until(f"{row(name)} !== null")
    page.evaluate(f"{row(name)}.querySelector('.name').click()")
    page.until(f"document.querySelector('#chosen').textContent === {json.dumps(name)}")


def plot(page: Page, topic: str, path: str) -> None:
    """Clicks on the button beside the number, when it is there."""
    button = f"[data-plot={json.dumps(topic + ':' + path)}]"
    page.until(f"document.querySelector({json.dumps(button)}) !== null")
    page.click(button)


def received(gateway: FakeGateway) -> dict[str, Any]:
    return gateway.received.get(timeout=20)


# Topics


def test_topics_are_listed_with_type_rate_age_and_value(gateway: FakeGateway, page: Page) -> None:
    gateway.list_topics(["/imu"], rate=49.97)
    gateway.data(
        "/imu",
        {"header": {"stamp": {"sec": 5}, "frame_id": "h"}, "linear": {"x": 0.10000000149011612}, "frame_id": "base"},
    )
    text = page.until(f"{row('/imu')}?.innerText.includes('linear') && {row('/imu')}.innerText")
    assert "sensor_msgs/msg/Imu" in text
    assert "50.0 Hz" in text
    assert re.search(r"\d\.\d s", text)
    assert 'linear: {x: 0.1}, frame_id: "base"' in text


def test_documents_of_one_message_are_separated_by_newlines(gateway: FakeGateway, page: Page) -> None:
    gateway.say(data_document("/b", {"x": 1}), data_document("/a", {"x": 2}))
    page.until(f"{row('/a')} !== null && {row('/b')} !== null")
    names = page.evaluate("[...document.querySelectorAll('.name')].map(e => e.textContent)")
    assert names == ["/a", "/b"]


def test_a_document_with_its_keys_in_another_order_is_understood(gateway: FakeGateway, page: Page) -> None:
    gateway.say('{"data": {"id": 18446744073709551615}, "time": 1.5, "type": "a/msg/B", "topic": "/a", "op": "data"}')
    page.until(f"{row('/a')}?.innerText.includes('18446744073709551615')")


def test_the_filter_wants_all_its_words_in_name_or_type(gateway: FakeGateway, page: Page) -> None:
    gateway.list_topics(["/loki_1/imu", "/loki_1/odom", "/loki_2/imu"])
    page.until("document.querySelectorAll('tbody tr').length === 3")
    page.type("#filter", "ODOM loki_1")
    page.until("document.querySelectorAll('tbody tr').length === 1")
    assert page.text("tbody .name") == "/loki_1/odom"
    assert page.text("#count") == "1 of 3"


def test_a_topic_that_stops_is_stale_and_one_that_left_the_list_is_gone(gateway: FakeGateway, page: Page) -> None:
    gateway.list_topics(["/imu", "/once"])
    gateway.data("/once", {"x": 0})
    for value in range(4):
        gateway.data("/imu", {"x": value})
        time.sleep(0.1)
    choose(page, "/once")
    page.until(f"{row('/imu')}.className === 'stale' && {row('/imu')}.innerText.includes('stale')")
    assert page.evaluate(f"{row('/once')}.className") == "chosen"
    gateway.list_topics(["/once"])
    page.until(f"{row('/imu')}.className === 'gone' && {row('/imu')}.innerText.includes('gone')")
    gateway.list_topics(["/imu", "/once"])
    gateway.data("/imu", {"x": 9})
    page.until(f"{row('/imu')}.className === ''")


def test_a_topic_on_which_nothing_is_published_is_dimmed(gateway: FakeGateway, page: Page) -> None:
    gateway.rows = [{"topic": f"/{name}", "type": "a/msg/B", "rate": rate} for name, rate in (("dead", 0), ("on", 9))]
    gateway.data("/on", {"x": 0})
    choose(page, "/on")
    page.until(f"{row('/dead')}?.className === 'dead'")
    faint, text = (page.evaluate(f"getComputedStyle({row(name)}).color") for name in ("/dead", "/on"))
    assert faint != text
    gateway.data("/dead", {"x": 0})  # the last value of a latched topic
    page.until(f"{row('/dead')}.className === ''")
    page.evaluate("topics.get('/dead').arrived -= 60000")
    page.until(f"{row('/dead')}.className === 'dead'")


def test_types_and_names_are_not_cut(gateway: FakeGateway, page: Page) -> None:
    long = "trajectory_msgs/msg/MultiDOFJointTrajectory"
    gateway.list_topics(["/a"], type_name=long)
    gateway.data("/a", {"x": 1}, long)
    cell = f"{row('/a')}?.querySelector('.type')"
    for size in ((1366, 768), (1920, 1080)):
        show_at(page, size)
        page.until(f"{cell}?.textContent === '{long}' && {cell}.scrollWidth <= {cell}.clientWidth")


def test_names_that_do_not_fit_lose_the_namespace_of_most_and_differ(gateway: FakeGateway, page: Page) -> None:
    names = [f"/expedition/science_payload/{unit}_of_the_secondary_rover/filtered" for unit in ("imu", "gps", "arm")]
    shown = "[...document.querySelectorAll('tbody .name')].map((each) => each.textContent)"
    gateway.list_topics([*names, "/rosout"])
    for size in (PHONE, (1366, 768)):
        show_at(page, size)
        page.until(f"{shown}.length === 4 && {shown}.filter((name) => name.startsWith('…/')).length === 3")
        assert len(set(page.evaluate(shown))) == 4
        assert "/rosout" in page.evaluate(shown)
    page.evaluate("document.querySelector('tbody').style.fontSize = '4px'; fitNames()")
    assert page.evaluate(shown) == sorted([*names, "/rosout"])


def test_long_names_lose_their_middle_and_leave_room_for_values(gateway: FakeGateway, page: Page) -> None:
    names = [
        f"/vehicle/{side}_wheel_module/suspension_actuator_temperature/raw_measurement" for side in ("left", "right")
    ]
    gateway.list_topics(names)
    for name in names:
        gateway.data(name, {"x": 1.25, "y": -2.5})
    for size in (PHONE, (1366, 768), (1920, 1080)):
        show_at(page, size)
        for name in names:
            page.until(f"{row(name)}?.innerText.includes('x: 1.25, y: -2.5')")
            cell = f"{row(name)}.querySelector('.name')"
            page.until(f"{cell}.scrollWidth <= {cell}.clientWidth && {cell}.scrollHeight <= {cell}.clientHeight")
            assert page.evaluate(f"{cell}.ariaLabel") == name
        texts = page.evaluate("[...document.querySelectorAll('.name')].map((cell) => cell.textContent)")
        assert len(set(texts)) == len(names)
        assert all(text.endswith("measurement") for text in texts)


def test_a_stamp_is_also_shown_in_local_time(gateway: FakeGateway, page: Page) -> None:
    page.call("Emulation.setTimezoneOverride", timezoneId="Asia/Kolkata")
    gateway.data("/imu", {"stamp": {"sec": 1700000000, "nanosec": 250_000_000}, "delay": {"sec": 5, "nanosec": 0}})
    choose(page, "/imu")
    notes = "[...document.querySelectorAll('#tree summary')].map((line) => line.textContent.trim())"
    expected = ["sensor_msgs/msg/Imu", "stamp 2023-11-15 03:43:20.250 +05:30", "delay"]
    page.until(f"{notes}.join() === {json.dumps(','.join(expected))}")


STAMP = schema("Time", field("sec", "int32"))
IMU = schema(
    "Imu",
    field("header", schema("Header", field("stamp", STAMP), field("frame_id", "string"))),
    field("orientation", schema("Quaternion", *(field(axis, "float64") for axis in "xyzw"))),
    field("angular_velocity", schema("Vector3", *(field(axis, "float64") for axis in "xyz"))),
    field("parts", schema("Part", field("name", "string"), field("id", "uint8")), is_array=True),
)
SORTED = {
    "angular_velocity": {"x": 4, "y": 5, "z": 6},
    "header": {"frame_id": "imu_link", "stamp": {"sec": 7}},
    "orientation": {"w": 1, "x": 0, "y": 0, "z": 0},
    "parts": [{"id": 1, "name": "a"}],
}


def test_fields_are_in_the_order_of_the_message(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/imu", SORTED)
    choose(page, "/imu")
    keys = "[...document.querySelectorAll('#tree .inner .key')].map(e => e.textContent.replace(': ', ''))"
    page.until(f"{keys}[0] === 'angular_velocity'")
    gateway.say({"op": "schema", "type": "sensor_msgs/msg/Imu", "time": 1.0, "schema": IMU})
    ordered = ["header", "stamp", "sec", "frame_id", "orientation", *"xyzw", "angular_velocity", *"xyz", "parts", "[0]"]
    page.until(f"{keys}.join() === {json.dumps(','.join([*ordered, 'name', 'id']))}")
    page.until(f"{row('/imu')}.querySelector('.preview').textContent.startsWith('orientation: {{x: 0, y: 0')")


def test_a_value_has_the_name_of_its_constant(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/battery", {"status": 4, "cells": [{"health": 1}, {"health": 9}], "constructor": 4})
    choose(page, "/battery")
    cell = schema("Cell", field("health", "uint8") | {"names": {"1": "GOOD"}})
    status = field("status", "uint8") | {"names": {"4": "<b>FULL</b>"}}
    battery = schema("Battery", status, field("cells", cell, is_array=True), field("constructor", "uint8"))
    gateway.say({"op": "schema", "type": "sensor_msgs/msg/Imu", "time": 1.0, "schema": battery})
    numbers = "[...document.querySelectorAll('#tree .number')].map((each) => each.textContent).join()"
    page.until(f"{numbers} === '4 (<b>FULL</b>),1 (GOOD),9,4'")


def test_on_a_wide_screen_the_first_topic_with_a_rate_is_open(gateway: FakeGateway, page: Page) -> None:
    show_at(page, PHONE)
    gateway.rows = [{"topic": f"/{name}", "type": "a/msg/B", "rate": 5 * (name != "a")} for name in "abc"]
    gateway.say(*(data_document(f"/{name}", {"x": 1}) for name in "abc"))
    page.until(f"{row('/b')}?.innerText.includes('5.0 Hz')")
    assert page.evaluate("chosen") is None
    show_at(page, (1366, 768))
    page.until("document.querySelector('#chosen').textContent === '/b'")
    page.until("document.querySelector('#tree').textContent.includes('x: 1')")


def test_on_a_phone_sending_does_not_outshine_the_topics(page: Page) -> None:
    show_at(page, PHONE)
    ground = "getComputedStyle(document.querySelector('{}')).backgroundColor"
    page.until("document.querySelector('#open-send').checkVisibility()")
    assert page.evaluate(ground.format("#open-send")) == page.evaluate(ground.format("body"))


def test_only_rows_in_sight_are_rendered(gateway: FakeGateway, page: Page) -> None:
    names = [f"/topic_{number:03}" for number in range(300)]
    gateway.list_topics(names)
    gateway.say(*(data_document(name, {"x": 7}) for name in names))
    page.until(f"{row(names[0])}?.innerText.includes('x: 7')")
    assert page.evaluate("[...document.querySelectorAll('.preview')].filter(e => e.textContent).length") < 40
    page.evaluate("document.querySelector('#rows').scrollTop = 1e6")
    page.until(f"{row(names[-1])}.innerText.includes('x: 7')")


# The tree and the plot


def test_the_tree_shows_the_full_value_and_follows_it(gateway: FakeGateway, page: Page) -> None:
    covariance = [0.5, None, 2.0]
    value = {
        "linear": {"x": 1.5},
        "id": 2**63 + 1,
        "on": True,
        "covariance": covariance,
        "text": "",
        "points": [{"y": 3}],
    }
    gateway.data("/imu", value)
    choose(page, "/imu")
    page.until("document.querySelector('#tree').textContent.includes('x: 1.5')")
    text = page.evaluate("document.querySelector('#tree').textContent")
    for line in ("id: 9223372036854775809", "on: true", "[1]: null (NaN or infinite)", "[2]: 2", 'text: ""', "y: 3"):
        assert line in text
    gateway.data("/imu", {**value, "linear": {"x": 2.5}, "covariance": []})
    page.until("document.querySelector('#tree').textContent.includes('x: 2.5')")
    assert "[2]" not in page.text("#tree")


def test_numbers_are_rounded_for_the_eye_and_exact_on_demand(gateway: FakeGateway, page: Page) -> None:
    value = {"a": 0.1 + 0.2, "b": -1.5, "c": 2**64 - 1, "d": 9007199254740991, "e": 1e-7 / 3, "f": 12345678.9}
    value |= {"latitude": 51.09931234567, "float32": 9.798620223999023}
    gateway.data("/imu", value)
    choose(page, "/imu")
    page.until("document.querySelectorAll('#tree .number').length === 8")
    shown = page.evaluate("[...document.querySelectorAll('#tree .number')].map(e => [e.textContent, e.title])")
    assert shown == [
        ["0.3", "0.30000000000000004"],
        ["-1.5", ""],
        ["18446744073709551615", ""],
        ["9007199254740991", ""],
        ["3.33333e-8", "3.3333333333333334e-8"],
        ["12345679", "12345678.9"],
        ["51.099312", "51.09931234567"],
        ["9.79862", ""],
    ]
    page.evaluate("document.querySelector('#tree .plot').focus({ focusVisible: true })")
    beside = "getComputedStyle(document.querySelector('#tree .number'), '::after').content"
    assert page.evaluate(beside) == '" = 0.30000000000000004"'


def test_long_arrays_are_opened_in_parts(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/scan", {"ranges": [n / 8 for n in range(10_000)], "text": "x" * 100_000})
    choose(page, "/scan")
    page.until("document.querySelector('#tree').innerText.includes('[10000]')")
    assert page.evaluate("document.querySelectorAll('#tree *').length") < 100
    page.click("#tree details details summary")
    page.until("document.querySelectorAll('#tree .plot').length === 100")
    page.click("#tree .more:not([hidden])")
    page.until("document.querySelectorAll('#tree .plot').length === 200")
    assert "… (100000 characters)" in page.text("#tree")


def coloured(page: Page, colour: str) -> list[int]:
    """Columns of the canvas that have a pixel in one of the plot's colours, within the axes."""
    page.evaluate("render()")
    expression = f"""(() => {{
        const canvas = document.querySelector('#plot canvas');
        const probe = document.createElement('canvas').getContext('2d');
        probe.fillStyle = getComputedStyle(canvas).getPropertyValue({json.dumps(colour)}); probe.fillRect(0, 0, 1, 1);
        const [r, g, b] = probe.getImageData(0, 0, 1, 1).data, {{width, height}} = canvas;
        const pixels = canvas.getContext('2d').getImageData(0, 0, width, height).data, columns = [];
        for (let x = 0; x < width; x++) for (let y = 0; y < height; y++) {{
            const at = 4 * (y * width + x);
            if (pixels[at] === r && pixels[at + 1] === g && pixels[at + 2] === b) {{ columns.push(x); break; }}
        }}
        return columns;
    }})()"""
    columns: list[int] = page.evaluate(expression)
    return columns


def test_chosen_numbers_are_plotted_with_their_bounds(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/imu", {"linear": {"x": 1}, "ranges": [0, 8]})
    choose(page, "/imu")
    plot(page, "/imu", "linear.x")
    plot(page, "/imu", "ranges[1]")
    for value in range(6):
        gateway.data("/imu", {"linear": {"x": value}, "ranges": [0, 8]})
    page.until("document.querySelector('#legend li').title === '/imu linear.x: 5, 0 to 5'")
    assert " ".join(page.text("#legend").split()) == "linear.x /imu 5 0 to 5 ✕ ranges[1] /imu 8 8 to 8 ✕"
    assert coloured(page, "--plot-0")
    assert coloured(page, "--plot-1")
    assert "linear.x: 5, 0 to 5" in page.evaluate("document.querySelector('#plot canvas').getAttribute('aria-label')")
    page.click("#legend button")
    page.until("document.querySelectorAll('#legend li').length === 1")
    assert coloured(page, "--plot-0") == []
    assert page.evaluate("document.querySelectorAll('#tree [aria-pressed=true]').length") == 1


def test_numbers_are_plotted_with_the_keyboard(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/imu", {"x": 1.25})
    choose(page, "/imu")
    assert page.evaluate("document.querySelector('#plot').checkVisibility()") is False
    button = "document.querySelector('[data-plot=\"/imu:x\"]')"
    page.until(f"{button} !== null")
    page.evaluate(f"{button}.focus()")
    for pressed in ("true", "false"):
        page.key("Enter")
        page.until(f"{button}.ariaPressed === '{pressed}'")
        assert page.evaluate("document.querySelector('#plot').checkVisibility()") is (pressed == "true")


def test_a_gap_in_the_values_is_a_gap_in_the_plot(gateway: FakeGateway, page: Page) -> None:
    show_at(page, (1920, 1080))
    gateway.data("/imu", {"x": 1.0})
    choose(page, "/imu")
    plot(page, "/imu", "x")
    # Three stretches of a minute, without waiting for one: a value every half second, silence, values, NaN, values.
    page.evaluate("""(() => {
        const [series] = plots.values(), now = performance.now();
        series.topic.period = 500;
        Object.assign(series, { times: [], values: [], start: 0 });
        for (let ago = 55; ago >= 0; ago -= 0.5) {
            if (ago < 40 && ago > 30) continue;
            series.times.push(now - ago * 1000);
            series.values.push(ago === 10 ? NaN : 5);
        }
    })()""")
    columns = coloured(page, "--plot-0")
    steps = [after - before for before, after in itertools.pairwise(columns)]
    second = (columns[-1] - columns[0]) / 55
    wide = [step / second for step in steps if step > 1]
    assert [round(width) for width in wide] == [10, 1]


def test_a_topic_plotted_stays_plotted_while_another_is_looked_at(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/a", {"x": 1})
    gateway.data("/b", {"y": 1})
    choose(page, "/a")
    plot(page, "/a", "x")
    choose(page, "/b")
    gateway.data("/a", {"x": 4})
    page.until("document.querySelector('#legend li').title === '/a x: 4, 1 to 4'")


def test_extreme_numbers_are_plotted(gateway: FakeGateway, page: Page) -> None:
    extremes: list[list[Any]] = [[1e308, -1e308], [5e-324, 0.0], [1e9, 1e9 + 1e-7], [None], [2**64 - 1]]
    for number, values in enumerate(extremes):
        topic = f"/extreme_{number}"
        gateway.data(topic, {"x": values[0]})
        choose(page, topic)
        plot(page, topic, "x")
        for value in values:
            gateway.data(topic, {"x": value})
    gateway.data("/done", {})
    page.until(f"{row('/done')} !== null")
    page.evaluate("render()")
    assert "undefined" not in page.text("#legend")


def test_the_address_keeps_what_is_chosen(browser: Browser, gateway: FakeGateway) -> None:
    opened = browser.open(f"{gateway.url}?topic=/imu&field=linear.x&plot=/odom:list[1]")
    opened.until("document.querySelector('#state').textContent === 'connected'")
    gateway.list_topics(["/imu", "/odom"])
    gateway.say(data_document("/imu", {"linear": {"x": 3}}), data_document("/odom", {"list": [1, 2]}))
    opened.until("/linear.x\\s.imu\\s3\\s.*list.1.\\s.odom\\s2\\s/s.test(document.querySelector('#legend').innerText)")
    plot(opened, "/imu", "linear.x")
    opened.until("!location.hash.includes('field')")
    opened.call("Page.reload")
    opened.until(
        "document.querySelector('#legend li') !== null && document.querySelector('#chosen').textContent === '/imu'"
    )
    assert opened.evaluate("[...plots.keys()]") == ["/odom:list[1]"]
    opened.close()


PLOTTED = "[...plots.keys()]"


def test_a_new_address_in_an_open_page_is_followed(gateway: FakeGateway, page: Page) -> None:
    gateway.list_topics(["/imu", "/odom"])
    gateway.say(data_document("/imu", {"linear": {"x": 3, "y": 4}}), data_document("/odom", {"list": [1, 2]}))
    choose(page, "/imu")
    plot(page, "/imu", "linear.x")
    for address, topic, plotted in (
        ("topic=/odom", "/odom", []),
        ("topic=/imu&field=linear.x&field=linear.y&plot=/odom:list[1]", "/imu", ["linear.x", "linear.y", "list[1]"]),
        ("topic=/imu&field=linear.y", "/imu", ["linear.y"]),
        ("plot=/odom:list[0]", "/imu", ["list[0]"]),
        ("topic=%2Fodom&field=list%5B1%5D", "/odom", ["list[1]"]),
    ):
        page.evaluate(f"location.hash = {json.dumps(address)}")
        page.until(f"document.querySelector('#chosen').textContent === {json.dumps(topic)}")
        page.until(f"{PLOTTED}.map(key => key.split(':')[1]).join() === {json.dumps(','.join(plotted))}")
        names = "document.querySelectorAll('#legend li span:nth-child(2) b')"
        shown = page.evaluate(f"[...{names}].map(e => e.textContent)")
        assert shown == plotted
        kept = page.evaluate("Object.fromEntries(new URLSearchParams(location.hash.slice(1)))")
        assert kept["topic"] == topic
    page.until("document.querySelector('#tree').textContent.includes('list')")


def test_back_and_forward_go_from_address_to_address(gateway: FakeGateway, page: Page) -> None:
    gateway.say(*(data_document(f"/{name}", {"x": 1, "y": 2}) for name in "abc"))
    choose(page, "/a")
    plot(page, "/a", "x")
    page.evaluate("location.hash = 'topic=/b&field=y'")
    page.until(f"{PLOTTED}.join() === '/b:y'")
    choose(page, "/c")
    page.evaluate("location.hash = 'topic=/a'")
    page.until("document.querySelector('#chosen').textContent === '/a'")
    for step, topic, plotted in (("back", "/c", "/b:y"), ("back", "/a", "/a:x"), ("forward", "/c", "/b:y")):
        page.evaluate(f"history.{step}()")
        page.until(f"document.querySelector('#chosen').textContent === {json.dumps(topic)}")
        page.until(f"{PLOTTED}.join() === {json.dumps(plotted)}")


def test_a_new_address_opens_the_sheet_of_its_topic_on_a_phone(gateway: FakeGateway, page: Page) -> None:
    show_at(page, PHONE)
    gateway.say(data_document("/a", {"x": 1}), data_document("/b", {"y": 1}))
    choose(page, "/a")
    for _ in range(2):  # from within a sheet, and from the list
        page.evaluate("location.hash = 'topic=/b'")
        page.until("document.querySelector('#chosen').textContent === '/b' && document.body.dataset.sheet === 'detail'")
        plot(page, "/b", "y")
        page.click("#detail .back")
        page.until("document.body.dataset.sheet === ''")
        assert page.evaluate(f"[document.querySelector('#chosen').textContent, {PLOTTED}.join()]") == ["/b", "/b:y"]
        page.evaluate("removePlot('/b:y')")


# Pictures


@pytest.mark.parametrize(("kind", "told"), [("png", "bgr8; png compressed bgr8"), ("jpeg", "jpeg")])
def test_a_compressed_image_shows_its_picture(gateway: FakeGateway, page: Page, kind: str, told: str) -> None:
    draw = f"""(() => {{
        const canvas = Object.assign(document.createElement('canvas'), {{ width: 40, height: 30 }});
        const context = canvas.getContext('2d');
        context.fillStyle = '#c80000'; context.fillRect(0, 0, 40, 30);
        return canvas.toDataURL('image/{kind}').split(',')[1];
    }})()"""
    data = base64.b64decode(page.evaluate(draw))
    gateway.list_topics(["/camera"], type_name=IMAGE, rate=5.0)
    gateway.data("/camera", compressed_image(data, told), IMAGE)
    choose(page, "/camera")
    caption = f"{told}, 40 {TIMES} 30, {len(data) / 1000:.1f} kB, 5.0 Hz"
    page.until(f"document.querySelector('#picture figcaption').textContent === {json.dumps(caption)}")
    red, green, blue, _ = shown_pixel(page)
    assert red > 190
    assert green < 10
    assert blue < 10
    gateway.data("/camera", compressed_image(png(8, 4, (0, 0, 255)), "png"), IMAGE)
    page.until(f"document.querySelector('#picture figcaption').textContent.startsWith('png, 8 {TIMES} 4, ')")
    assert shown_pixel(page) == [0, 0, 255, 255]
    gateway.data("/imu", {"x": 1})
    choose(page, "/imu")
    assert page.evaluate("document.querySelector('#picture').checkVisibility()") is False


def test_what_is_no_picture_is_not_decoded(gateway: FakeGateway, page: Page) -> None:
    good = png(2, 2, (0, 0, 0))
    for data, told, reason in (
        (good, "16UC1; compressedDepth png", "its format is neither JPEG nor PNG"),
        (good, "svg", "its format is neither JPEG nor PNG"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "png", "its data are neither JPEG nor PNG"),
        (b"", "jpeg", "its data are neither JPEG nor PNG"),
        (b"\xff\xd8\xff", "jpeg", "its data are neither JPEG nor PNG"),
        (good[:16] + b"\0\0\xff\xff\0\0\xff\xff" + good[24:], "png", f"65535 {TIMES} 65535 pixels are too many"),
        (good[:40], "png", ""),
        ("not a list", "png", "its format is neither JPEG nor PNG"),
    ):
        gateway.data("/camera", compressed_image(data, told), IMAGE)
        choose(page, "/camera")
        page.until(f"document.querySelector('#picture figcaption').textContent.startsWith('No picture: {reason}')")
        assert page.evaluate("document.querySelector('#picture canvas').checkVisibility()") is False
        gateway.data("/camera", compressed_image(good, "png"), IMAGE)
        page.until("document.querySelector('#picture canvas').checkVisibility()")


# Sending


def test_the_form_starts_at_the_defaults_and_sends_what_was_typed(gateway: FakeGateway, page: Page) -> None:
    before = time.time()
    page.type("[data-field='linear.x']", ".25")
    page.type("[data-field='angular.z']", "-1")
    page.click("[form=form]")
    sent = received(gateway)
    assert before - 1 <= sent.pop("time") <= time.time() + 1
    data = {"linear": {"x": 0.25, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": -1}}
    assert sent == {"op": "publish", "topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "data": data}
    page.until("document.querySelector('#sent').textContent.startsWith('Sent 1, none rejected.')")


def test_every_kind_of_field_can_be_filled_in_and_integers_are_exact(gateway: FakeGateway, page: Page) -> None:
    choose_target(page, "/mode")
    page.click("[data-field=is_armed]")
    page.type("[data-field=name]", HOSTILE)
    page.type("[data-field=level]", "007")
    page.type("[data-field=id]", str(2**64 - 1))
    page.type("[data-field=gains]", "[1, 2.5]")
    page.key("Tab")
    page.click("[form=form]")
    expected = {"is_armed": True, "name": HOSTILE, "level": 7, "id": 2**64 - 1, "gains": [1, 2.5]}
    assert received(gateway)["data"] == expected
    page.click("#as-json")
    assert json.loads(page.evaluate("document.querySelector('#json').value")) == expected
    page.click("[form=form]")
    assert received(gateway)["data"] == expected
    page.click("#as-json")
    page.click("[form=form]")
    assert received(gateway)["data"] == expected


def choose_target(page: Page, topic: str) -> None:
    select = "document.querySelector('#target')"
    page.evaluate(f"{select}.value = {json.dumps(topic)}; {select}.dispatchEvent(new Event('change'))")


def test_what_does_not_fit_is_not_sent(gateway: FakeGateway, page: Page) -> None:
    choose_target(page, "/mode")
    for name, text, fitting, problem in (
        ("level", "256", "1", "level: must be from 0 to 255"),
        ("level", "1.5", "1", "level: must be a whole number"),
        ("level", "", "1", "level: must be a number"),
        ("level", "1,000", "1", "level: must be a number"),
        ("id", "18446744073709551616", "1", "id: must be from 0 to 18446744073709551615"),
        ("gains", "[1, 1e39]", "[]", "gains[1]: is too large for a float32"),
        ("gains", "[1, null]", "[]", "gains[1]: must be a number"),
        ("gains", "1", "[]", "gains: must be an array"),
        ("gains", "[1", "[]", "gains: must be an array"),
    ):
        page.type(f"[data-field={name}]", text)
        page.key("Enter") if name != "gains" else page.click("[form=form]")
        page.until(f"document.querySelector('#sent').textContent.includes({json.dumps('Not sent. ' + problem)})")
        assert page.evaluate(f"document.querySelector('[data-field={name}]').ariaInvalid") == "true"
        page.type(f"[data-field={name}]", fitting)
    assert gateway.received.empty()


def test_json_that_does_not_fit_is_not_sent(gateway: FakeGateway, page: Page) -> None:
    choose_target(page, "/mode")
    page.click("#as-json")
    for change, problem in (
        ({"extra": 1}, "extra: there is no such field"),
        ({"name": 5}, "name: must be text"),
        ({"is_armed": 1}, "is_armed: must be true or false"),
    ):
        page.type("#json", json.dumps(MIXED["example"] | change))  # type: ignore[operator]
        page.click("[form=form]")
        page.until(f"document.querySelector('#sent').textContent.includes({json.dumps('Not sent. ' + problem)})")
    assert gateway.received.empty()


def test_a_message_is_repeated_while_the_box_is_ticked(gateway: FakeGateway, page: Page) -> None:
    page.type("#rate", "50")
    page.click("#repeat")
    assert [received(gateway)["topic"] for _ in range(5)] == ["/cmd_vel"] * 5
    page.click("#repeat")
    assert page.evaluate("repeating") == 0


def test_edits_are_repeated_only_when_they_are_complete(gateway: FakeGateway, page: Page) -> None:
    page.type("#rate", "50")
    page.click("#repeat")
    page.type("[data-field='linear.x']", "15")
    assert {received(gateway)["data"]["linear"]["x"] for _ in range(20)} == {0}
    page.key("Tab")
    while received(gateway)["data"]["linear"]["x"] != 15:
        pass
    page.type("[data-field='linear.x']", "oops")
    page.key("Tab")
    page.until("repeating === 0 && !document.querySelector('#repeat').checked")


def test_a_message_is_repeated_while_the_button_is_held(gateway: FakeGateway, page: Page) -> None:
    page.type("#rate", "50")
    page.press_mouse("#hold")
    for _ in range(5):
        received(gateway)
    page.release_mouse("#hold")
    assert page.evaluate("repeating") == 0


def test_a_refusal_is_shown_with_reason_and_detail(gateway: FakeGateway, page: Page) -> None:
    page.click("[form=form]")
    received(gateway)
    gateway.say({"op": "rejected", "reason": "stale", "detail": f"0.5 s old {HOSTILE}", "topic": "/cmd_vel"})
    page.until("document.querySelector('#sent').textContent.includes('1 rejected. Rejected (stale): 0.5 s old <img')")
    assert page.evaluate("document.querySelector('#sent').className") == "bad"
    page.click("[form=form]")
    page.until("document.querySelector('#sent').textContent.trim() === 'Sent 2, 1 rejected.'")
    assert page.evaluate("document.querySelector('#sent').className") == "good"


def test_a_wrong_clock_is_pointed_out(gateway: FakeGateway, page: Page) -> None:
    gateway.clock_error = 30.0
    page.until("document.querySelector('#clock').innerText.includes('30 s behind')")


def test_a_gateway_that_lets_nothing_in_has_no_form(browser: Browser, gateway: FakeGateway) -> None:
    gateway.inbound = []
    opened = browser.open(gateway.url)
    opened.until("document.querySelector('#state').textContent === 'connected'")
    assert opened.evaluate("document.querySelector('#send').checkVisibility()") is False
    opened.close()


# The connection


def test_the_page_reconnects_and_keeps_what_was_typed(gateway: FakeGateway, page: Page) -> None:
    gateway.list_topics(["/imu"])
    page.type("[data-field='linear.x']", "0.75")
    page.click("#repeat")
    received(gateway)
    gateway.go_down()
    page.until("document.querySelector('#state').textContent.startsWith('no connection')")
    assert re.fullmatch(r"No answer from the gateway since \d\d:\d\d:\d\d GMT\S* \(.* s\)", page.text("#silence"))
    assert page.evaluate("getComputedStyle(document.querySelector('main')).filter") == "grayscale(1)"
    assert page.evaluate("document.querySelector('[form=form]').disabled") is True
    assert page.evaluate("repeating") == 0
    gateway.reset()
    page.until("document.querySelector('#state').textContent === 'connected'")
    assert page.evaluate("document.querySelector('#silence').hidden")
    assert page.evaluate("getComputedStyle(document.querySelector('main')).filter") == "none"
    page.click("[form=form]")
    assert received(gateway)["data"]["linear"]["x"] == 0.75


def test_a_connection_that_is_silent_is_opened_anew(gateway: FakeGateway, page: Page) -> None:
    first = set(gateway.clients)
    page.evaluate("heardAt -= 60000")
    page.until("document.querySelector('#state').textContent === 'connected'")
    page.evaluate("heardAt -= 60000; render()")
    page.until("document.querySelector('#state').textContent === 'connected' && !retryAt")
    assert not first & gateway.clients


def test_a_connection_without_a_document_for_seconds_is_not_green(page: Page) -> None:
    """Of a gateway whose computer lost its power, no connection ends."""
    state, silence = page.evaluate(
        "answeredAt -= 5000; renderConnection();"
        "[document.querySelector('#state').className, document.querySelector('#silence').innerText]"
    )
    assert state == "bad"
    assert silence.startswith("No answer from the gateway since ")
    page.until("document.querySelector('#state').className === 'good' && document.querySelector('#silence').hidden")


def test_what_cannot_be_read_is_counted_and_ends_nothing(gateway: FakeGateway, page: Page) -> None:
    gateway.say(
        "{",
        "null",
        '{"op":"topics"}',
        '{"op":"unheard of"}',
        '{"op":"data","topic":"/x","type":"t","time":1,"data":{x}}',
    )
    choose(page, "/x")
    page.until("document.querySelector('#tree').innerText === 'This value cannot be read.'")
    page.until("document.querySelector('#state').textContent === 'connected, 3 messages unreadable'")


# Safety, looks and hands


def test_hostile_text_stays_text(browser: Browser, gateway: FakeGateway) -> None:
    evil = {
        "topic": f"/{HOSTILE}",
        "type": HOSTILE,
        "schema": schema(HOSTILE, field(HOSTILE, "string")),
        "example": {HOSTILE: HOSTILE},
    }
    gateway.inbound = [evil]
    page = browser.open(gateway.url)
    page.until("document.querySelector('#state').textContent === 'connected'")
    gateway.list_topics([HOSTILE], type_name=HOSTILE)
    gateway.data(HOSTILE, {HOSTILE: HOSTILE, "n": {"__proto__": 1}, "constructor": [1]}, type_name=HOSTILE)
    choose(page, HOSTILE)
    plot(page, HOSTILE, "constructor[0]")
    page.click("[form=form]")
    gateway.say({"op": "rejected", "reason": HOSTILE, "detail": HOSTILE, "topic": HOSTILE})
    page.until("document.querySelector('#sent').textContent.includes('onerror')")
    assert page.evaluate("document.querySelectorAll('img').length") == 0
    assert page.evaluate("window.hacked ?? null") is None
    assert page.complaints() == []
    page.close()


def test_nothing_comes_from_elsewhere() -> None:
    text = PAGE.read_text(encoding="utf-8")
    icon = r"""<link rel="icon" href="data:image/svg\+xml,<svg xmlns='http://www.w3.org/2000/svg' [^"]*">"""
    text, icons = re.subn(icon, "", text)
    assert icons == 1
    assert not re.search(
        r"https?://|\bsrc=|\bhref=|@import|url\(|\beval\(|innerHTML|insertAdjacentHTML|document\.write", text
    )


def test_topics_are_found_and_chosen_with_the_keyboard(gateway: FakeGateway, page: Page) -> None:
    gateway.list_topics(["/a/imu", "/b/imu", "/b/odom"])
    page.until("document.querySelectorAll('tbody tr').length === 3")
    for key in ("/", "b", "ArrowDown", "ArrowDown", "Enter"):
        page.key(key)
    page.until("document.querySelector('#chosen').textContent === '/b/odom'")


def is_seen(page: Page, selector: str) -> bool:
    found: bool = page.evaluate(f"document.querySelector('{selector}').checkVisibility({{visibilityProperty: true}})")
    return found


@pytest.mark.parametrize("way", ["button", "Escape", "back"])
def test_on_a_phone_a_topic_opens_a_sheet(gateway: FakeGateway, page: Page, way: str) -> None:
    show_at(page, PHONE)
    gateway.data("/imu", {"x": 1})
    choose(page, "/imu")
    page.until("document.querySelector('#tree').textContent.includes('x: 1')")
    box = page.evaluate("document.querySelector('#detail').getBoundingClientRect().toJSON()")
    assert (box["left"], box["top"], box["width"], box["height"]) == (0, 0, *PHONE)
    assert [is_seen(page, part) for part in ("#topics", "header", "#tree")] == [False, False, True]
    if way == "button":
        page.click("#detail .back")
    elif way == "Escape":
        page.key("Escape")
    else:
        page.evaluate("history.back()")
    page.until("document.body.dataset.sheet === ''")
    assert [is_seen(page, part) for part in ("#topics", "header", "#tree")] == [True, True, False]
    assert page.evaluate("document.activeElement.textContent") == "/imu"
    page.evaluate("history.forward()")
    page.until("document.querySelector('#tree').checkVisibility()")
    show_at(page, (1440, 900))
    assert [is_seen(page, part) for part in ("#topics", "header", "#tree")] == [True, True, True]


def test_a_repeated_message_ends_with_its_sheet(gateway: FakeGateway, page: Page) -> None:
    show_at(page, PHONE)
    page.click("#open-send")
    page.click("#repeat")
    received(gateway)
    page.key("Escape")
    page.until("document.body.dataset.sheet === ''")
    assert page.evaluate("repeating") == 0


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("size", SIZES)
def test_nothing_is_too_faint_too_small_or_too_wide(
    gateway: FakeGateway, page: Page, size: tuple[int, int], theme: str
) -> None:
    gateway.list_topics([f"/a_rather_long_namespace/topic_{number}" for number in range(30)] + ["/imu", "/stale"])
    gateway.data("/imu", {"linear": {"x": 0.12345678901234567, "y": -1}, "text": "x" * 300, "list": list(range(99))})
    show_at(page, size, theme)
    checks = (contrast_problems, unnamed_controls, overflows, small_texts, small_targets, hidden_focus)

    def found() -> list[str]:
        return [f"{check.__name__}: {problem}" for check in checks for problem in check(page)]

    page.until(f"{row('/imu')} !== null")
    assert found() == []
    choose(page, "/imu")
    plot(page, "/imu", "linear.x")
    plot(page, "/imu", "linear.y")
    page.evaluate("render()")
    assert found() == []
    if size == PHONE:
        page.key("Escape")
        page.until("document.body.dataset.sheet === ''")
        page.click("#open-send")
        assert found() == []


def test_every_control_has_a_name_for_assistive_technology(gateway: FakeGateway, page: Page) -> None:
    gateway.data("/imu", {"x": 1, "list": [1]})
    choose(page, "/imu")
    plot(page, "/imu", "x")
    choose_target(page, "/mode")
    page.call("Accessibility.enable")
    nodes = page.call("Accessibility.getFullAXTree")["nodes"]
    controls = {"button", "checkbox", "combobox", "image", "searchbox", "spinbutton", "textbox"}
    roles = [
        (node["role"]["value"], node["name"]["value"])
        for node in nodes
        if node.get("role", {}).get("value") in controls
    ]
    assert {role for role, _ in roles} == controls
    assert [role for role, name in roles if not name.strip()] == []


def test_the_page_follows_the_colour_scheme(page: Page) -> None:
    for scheme in ("light", "dark"):
        page.prefer(scheme)
        ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, re.findall(r"\d+", ground))) > 600) is (scheme == "light")
