"""The status page of a running router, in a real browser, as a person uses it in the field."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from router.compiler import check_table
from router.errors import SourceSpan
from router.observe import responses
from router.observe.http import HttpServer
from router.table.addresses import Address
from tests.gateway.browser import Browser, Page, executable
from tests.observe.fake_running import FakeRunning, sim_program

PROGRAM = executable()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium here: the page is tested in a real browser only"),
]

BOARD = ("127.0.0.30", 25008)
PHONE, DESKTOP = (390, 844), (1366, 900)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    assert PROGRAM is not None
    running = Browser(PROGRAM, tmp_path_factory.mktemp("chromium"))
    yield running
    running.close()


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeRunning]:
    """All endpoints were heard just now, and the page asks ten times as often."""
    monkeypatch.setattr(responses, "KEPT_SECONDS", 0)
    page = responses.PAGE.read_text(encoding="utf-8")
    assert "const PERIOD = 1000;" in page
    hasty = tmp_path / "page.html"
    hasty.write_text(page.replace("const PERIOD = 1000;", "const PERIOD = 100;"), encoding="utf-8")
    monkeypatch.setattr(responses, "PAGE", hasty)
    opened = FakeRunning(sim_program())
    for endpoint in opened.program.table.endpoints:
        opened.count("endpoint_last_seen_timestamp_seconds", endpoint, to=2**62)
    opened.count("config_last_reload_successful", to=1)
    yield opened
    opened.mirror.close()
    assert opened.failures == []


@pytest.fixture
def url(running: FakeRunning) -> Iterator[str]:
    with closing(HttpServer(Address("127.0.0.1", 0), SourceSpan("t.yaml"), running, None)) as server:
        yield f"http://{server.address}/"


def open_page(browser: Browser, url: str, size: tuple[int, int] = DESKTOP) -> Page:
    """The page when it has shown something."""
    page = browser.open(url, *size)
    page.until("document.querySelector('#state').textContent === 'running'")
    return page


@pytest.fixture
def page(browser: Browser, url: str) -> Iterator[Page]:
    """Whatever a test does with it, nothing in it may fail or break its policy."""
    opened = open_page(browser, url)
    yield opened
    complaints = [text for text in opened.complaints() if "ERR_CONNECTION" not in text]
    opened.close()
    assert complaints == []


def box(key: str) -> str:
    """JavaScript for the box of a part of the map."""
    return f"nodes.get({json.dumps(key)}).element"


def line(start: str, end: str) -> str:
    """JavaScript for the line between two."""
    return f"links.find((link) => link.start === {json.dumps(start)} && link.end === {json.dumps(end)})"


def choose(page: Page, key: str) -> None:
    page.evaluate(f"{box(key)}.dispatchEvent(new MouseEvent('click'))")
    page.until(f"document.querySelector('#name').textContent === nodes.get({json.dumps(key)}).name")


def test_the_map_shows_the_whole_table(page: Page) -> None:
    shown = set(page.evaluate("[...nodes.values()].map((node) => node.name)"))
    table = sim_program().table
    assert set(table.endpoints) - {"container_board"} <= shown
    assert {route.case.value for route in table.routes} <= shown
    assert {topic.topic.value for route in table.routes for topic in route.topics} <= shown
    assert page.evaluate("document.querySelectorAll('.node').length") == page.evaluate("nodes.size")


def test_a_table_with_gateways_only_is_shown_as_well(browser: Browser, tmp_path: Path) -> None:
    table = tmp_path / "only.yaml"
    table.write_text("version: 1\ngateways: {headset: {transport: {udp: 127.0.0.9:8502}}}\n")
    program = check_table(table).program
    assert program is not None
    opened = FakeRunning(program)
    opened.count("config_last_reload_successful", to=1)
    with closing(HttpServer(Address("127.0.0.1", 0), SourceSpan("t.yaml"), opened, None)) as server:
        page = open_page(browser, f"http://{server.address}/")
        assert page.evaluate("[...nodes.values()].map((node) => node.name)") == [
            "ROS topics", "headset", "clients of headset",
        ]  # fmt: skip
        assert page.evaluate("document.querySelector('#well').hidden") is False
        assert page.complaints() == []
        page.close()
    opened.mirror.close()
    assert opened.failures == []


def test_a_line_is_as_wide_as_its_rate(running: FakeRunning, page: Page) -> None:
    slow, fast = ("gps_info", "basestation"), ("imu_info", "basestation")
    page.until("answers.length > 1")
    running.count("datagrams_sent", *slow, to=5)
    running.count("datagrams_sent", *fast, to=500)
    widths = [
        f"parseFloat({line(f'case:{case}', 'to:@basestation')}.line.style.strokeWidth)" for case, _ in (slow, fast)
    ]
    page.until(f"1 < {widths[0]} && {widths[0]} < {widths[1]}")
    assert page.evaluate(f"{line('case:imu_info', 'to:@basestation')}.state") == "flowing"
    assert page.evaluate(f"{line('case:ph_info', 'to:@basestation')}.state") == "never"


def test_what_is_dropped_is_red_and_said_in_words(running: FakeRunning, page: Page) -> None:
    assert page.evaluate("document.querySelector('#well').hidden") is False
    page.until("answers.length > 1")
    running.count("messages_dropped", "imu_info", "basestation", "send_error", to=12)
    page.until(f"{line('case:imu_info', 'to:@basestation')}.state === 'dropping'")
    stroke = page.evaluate(f"getComputedStyle({line('case:imu_info', 'to:@basestation')}.line).stroke")
    assert stroke == "rgb(192, 0, 0)"
    assert "imu_info to basestation is dropped 12 send_error in 10 s" in page.text("#troubles").replace("\n", " ")
    page.click("#troubles button")
    page.until("document.querySelector('#name').textContent === 'imu_info'")
    assert "dropped: 12 send_error" in page.text("#facts")


def test_what_the_table_holds_back_is_not_wrong(running: FakeRunning, page: Page) -> None:
    page.until("answers.length > 1")
    running.count("messages_dropped", "imu_info", "basestation", "rate_limited", to=12)
    running.count("datagrams_rejected", "rover", "ignored", to=12)
    page.until("sum(targetOf(now(), 'imu_info', 'basestation').dropped) === 12")
    page.until("answers.length > 2")
    assert page.evaluate("document.querySelector('#well').hidden") is False


def test_what_was_dropped_before_the_page_was_opened_is_no_trouble_now(
    browser: Browser, running: FakeRunning, url: str
) -> None:
    running.count("messages_dropped", "imu_info", "basestation", "send_error", to=12)
    page = open_page(browser, url)
    page.until(f"{line('case:imu_info', 'to:@basestation')}.state === 'dropped'")
    assert page.evaluate("document.querySelector('#troubles').hidden") is True
    page.close()


def test_what_is_wrong_is_said(running: FakeRunning, page: Page) -> None:
    page.until("answers.length > 1")
    running.count("endpoint_last_seen_timestamp_seconds", "arm_board", to=0)
    running.count("deadman_active", "manual_drive", to=1)
    running.count("config_last_reload_successful", to=0)
    running.count("qos_incompatible", "imu_info", "imu_data", "reliability", to=1)
    running.count("datagrams_rejected", "rover", "unhandled", to=3)
    running.count("unhandled", "arm_diag", to=3)
    page.until("document.querySelectorAll('#troubles li').length === 5")
    said = page.text("#troubles").replace("\n", " ")
    assert "The last reload failed the table from before it goes on: router reload says why" in said
    assert "arm_board is silent since the router was started" in said
    assert "manual_drive: the deadman is active" in said
    assert "imu_data: a peer gets nothing its QoS does not fit (reliability)" in said
    assert "rover rejects datagrams 3 unhandled (arm_diag) in 10 s" in said
    page.until("document.title.startsWith('⚠')")


def test_a_case_shows_its_numbers_and_its_last_value(running: FakeRunning, page: Page) -> None:
    running.count("messages_received", "imu_info", "sensor_board", to=1234)
    running.count("messages_filtered", "imu_info", "imu_data", to=34)
    choose(page, "case:imu_info")
    data = running.program.envelope.message_class(imu_info={"accel_x": 1.5}).SerializeToString()
    running.receive(data, BOARD)
    page.until("document.querySelector('#value')?.textContent.includes('accel_x: 1.5')")
    page.until("document.querySelector('#facts').textContent.includes('1\\u202f234')")
    assert "from sensor_board" in page.text("#facts")
    assert "nobody subscribes (34 left out)" in page.text("#facts")


HOSTILE = '<img src=x onerror="window.hacked=1">'
HOSTILE_PROTO = """\
syntax = "proto3";
message Inner { string text = 1; map<string, string> words = 2; }
message Note {
  string text = 1; repeated string lines = 2; bytes data = 3; Inner inner = 4; repeated Inner inners = 5;
  map<string, Inner> table = 6;
}
message Hostile {
  oneof payload { Note note = 1; Note constructor = 2; Note __proto__ = 3; Note toString = 4; Note valueOf = 5; }
}
"""
HOSTILE_TABLE = """\
version: 1
envelope: {protos: protos, message: Hostile, oneof: payload}
listen: {valueOf: {address: 127.0.0.1:5000}}
endpoints:
  constructor: {address: 127.0.0.2:8, kind: tool}
  toString: {address: 127.0.0.3:8, kind: tool}
routes:
  note: {source: constructor, destinations: [toString]}
  constructor: {source: any, destinations: [toString]}
  __proto__: {source: constructor, destinations: [toString]}
  toString: {source: constructor, destinations: [toString]}
"""


@pytest.fixture
def hostile(tmp_path: Path) -> FakeRunning:
    """A router whose table, of a hostile name, has names that JavaScript's objects have, and texts in its payloads."""
    folder = tmp_path / HOSTILE
    (folder / "protos").mkdir(parents=True)
    (folder / "protos" / "hostile.proto").write_text(HOSTILE_PROTO)
    (folder / "table.yaml").write_text(HOSTILE_TABLE)
    program = check_table(folder / "table.yaml").program
    assert program is not None
    return FakeRunning(program)


def test_texts_of_payloads_and_names_are_text_and_nothing_else(
    running: FakeRunning, hostile: FakeRunning, browser: Browser
) -> None:
    inner = {"text": HOSTILE, "words": {HOSTILE: HOSTILE, "__proto__": HOSTILE}}
    note: dict[str, object] = {"text": HOSTILE, "data": HOSTILE.encode(), "lines": [HOSTILE] * 2}
    note |= {"inner": inner, "inners": [inner], "table": {HOSTILE: inner}}
    cases = ("note", "constructor", "__proto__", "toString")
    with closing(HttpServer(Address("127.0.0.1", 0), SourceSpan("t.yaml"), hostile, None)) as server:
        page = open_page(browser, f"http://{server.address}/#%")
        assert HOSTILE in page.text("#table")
        for case in cases:
            choose(page, f"case:{case}")
            assert "None has come" in page.text("#facts")
            hostile.receive(
                hostile.program.envelope.message_class(**{case: note}).SerializeToString(), ("127.0.0.2", 8)
            )
            page.until("document.querySelector('#value') !== null")
            shown = page.text("#value")
            assert shown.count(HOSTILE) == 16
            assert f"__proto__: {HOSTILE}" in shown
        for key in ("from:@constructor", "to:@toString"):
            choose(page, key)
            assert page.evaluate("document.querySelectorAll('#facts table tr').length") > 1
        assert page.evaluate("document.querySelector('img') === null && window.hacked === undefined")
        assert page.text("#state") == "running"
        assert page.complaints() == []
        page.close()
    hostile.mirror.close()
    assert hostile.failures == []


def test_before_there_is_a_second_answer_no_rate_is_told(page: Page) -> None:
    page.until("answers.length > 1")
    numbers = "[...document.querySelectorAll('#tiles dd > span')].map((each) => each.textContent)"
    first = page.evaluate(f"answers = [now()]; render(); {numbers}")
    assert first[:5] == ["—"] * 5
    page.until(f"answers.length > 1 && {numbers}[0] === '0/s'")
    assert page.evaluate(numbers)[:5] == ["0/s", "0/s", "0", "0", "0"]


def test_pointing_shows_for_a_moment_and_clicking_keeps(page: Page) -> None:
    page.evaluate(f"{box('case:imu_info')}.dispatchEvent(new PointerEvent('pointerenter', {{pointerType: 'mouse'}}))")
    assert page.text("#name") == "imu_info"
    page.evaluate(f"{box('case:imu_info')}.dispatchEvent(new PointerEvent('pointerleave', {{pointerType: 'mouse'}}))")
    assert page.text("#name") == "Nothing chosen"
    choose(page, "from:@sensor_board")
    assert page.evaluate("location.hash") == "#from%3A%40sensor_board"
    page.key("Escape")
    assert page.text("#name") == "Nothing chosen"


def test_the_keyboard_reaches_every_box(page: Page) -> None:
    page.evaluate(f"{box('case:gps_info')}.focus()")
    page.key("Enter")
    assert page.text("#name") == "gps_info"


def test_a_router_that_ended_is_said_and_one_that_comes_back_is_shown(browser: Browser, running: FakeRunning) -> None:
    span = SourceSpan("t.yaml")
    server = HttpServer(Address("127.0.0.1", 0), span, running, None)
    page = open_page(browser, f"http://{server.address}/")
    assert page.text("#well") == "Nothing is wrong."
    server.close()
    page.until("!document.querySelector('#silence').hidden")
    assert_lost(page)
    with closing(HttpServer(server.address, span, running, None)):
        page.until("document.querySelector('#state').textContent === 'running'")
        assert_well(page)
        page.close()


def assert_lost(page: Page) -> None:
    """Nobody can take what is shown for what is."""
    assert re.fullmatch(r"No answer from the router since \d\d:\d\d:\d\d \(.* s\)", page.text("#silence"))
    assert (page.text("#state"), page.evaluate("document.querySelector('#state').className")) == ("no answer", "bad")
    assert page.evaluate("document.title") == "⚠ No answer from the router"
    assert "Nothing is wrong." not in page.text("body")
    for selector in ("#tiles", "#map", "#legend", "#facts"):
        style = page.evaluate(
            f"(({{opacity, filter}}) => [opacity, filter])(getComputedStyle(document.querySelector('{selector}')))"
        )
        assert style == ["0.45", "grayscale(1)"]


def assert_well(page: Page) -> None:
    assert page.text("#well") == "Nothing is wrong."
    assert page.evaluate("document.querySelector('#silence').hidden")
    assert page.evaluate("getComputedStyle(document.querySelector('#tiles')).opacity") == "1"


def test_before_the_first_answer_nothing_is_claimed(browser: Browser, running: FakeRunning, url: str) -> None:
    page = browser.open("about:blank")
    page.call(
        "Page.addScriptToEvaluateOnNewDocument", source="window.fetch = () => new Promise(r => { window.give_up = r; })"
    )
    page.go(url)
    shown = "(id => document.querySelector(id).checkVisibility())"
    assert page.text("#state") == "connecting"
    assert page.evaluate(f"['#well', '#troubles', '#silence'].map({shown})") == [False] * 3
    assert page.evaluate("document.querySelector('#state').className") == ""
    page.evaluate("give_up(Response.error())")
    page.until("document.querySelector('#silence').checkVisibility()")
    assert page.text("#silence").startswith("No answer from the router yet (")
    assert page.evaluate(f"['#well', '#troubles'].map({shown})") == [False] * 2
    page.close()


def test_a_page_that_was_hidden_claims_nothing_before_it_has_asked_again(page: Page) -> None:
    page.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
    page.until("next !== 0")
    page.evaluate("answeredAt -= 60000")
    page.evaluate("delete document.hidden")
    at_once = "comeBack(); [document.body.classList.contains('lost'), document.querySelector('#silence').innerText]"
    lost, said = page.evaluate(at_once)
    assert lost
    assert said.endswith("(60 s)")
    page.until("document.querySelector('#silence').hidden")


@pytest.mark.parametrize("size", [PHONE, DESKTOP, (320, 568), (768, 1024)], ids=str)
def test_nothing_is_wider_than_the_screen(browser: Browser, url: str, size: tuple[int, int]) -> None:
    page = open_page(browser, url, size)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    overflowing = """[...nodes.values()].filter(({text, box, element}) =>
        text.getBBox().x + text.getBBox().width > box[0] + box[2] + 0.5).map(({name}) => name)"""
    assert page.evaluate(overflowing) == []
    page.close()


def test_on_a_phone_details_cover_the_lower_half_and_close(browser: Browser, url: str) -> None:
    page = open_page(browser, url, PHONE)
    assert page.evaluate("document.querySelector('#detail').checkVisibility()") is False
    choose(page, "to:@driving_board")
    sheet = page.evaluate("document.querySelector('#detail').getBoundingClientRect().toJSON()")
    assert sheet["bottom"] == PHONE[1]
    assert sheet["top"] >= 0.4 * PHONE[1]
    page.until(f"{box('to:@driving_board')}.getBoundingClientRect().bottom < {sheet['top']}")
    page.click("#close")
    page.until("!document.querySelector('#detail').checkVisibility()")
    page.close()


LUMINANCE = """(selector, property) => {
  const [r, g, b] = getComputedStyle(document.querySelector(selector))[property].match(/[0-9.]+/g)
    .map((part) => (part / 255 <= 0.04045 ? part / 255 / 12.92 : ((part / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_stand_out_from_their_ground_in_the_light_and_in_the_dark(
    running: FakeRunning, page: Page, scheme: str
) -> None:
    page.prefer(scheme)
    running.count("deadman_active", "manual_drive", to=1)
    page.until("document.querySelector('#troubles b') !== null")
    ground = page.evaluate(f"({LUMINANCE})('body', 'backgroundColor')")
    assert ground > 0.9 if scheme == "light" else ground < 0.1
    for text, under, what in [
        ("body", "body", "color"),
        ("#table", "body", "color"),
        ("#tiles dt", "#tiles div", "color"),
        ("#troubles b", "#troubles", "color"),
        ("#state", "body", "color"),
        (".node.case text", ".node.case rect", "fill"),
    ]:
        grounds = "fill" if what == "fill" else "backgroundColor"
        pair = [
            page.evaluate(f"({LUMINANCE})({json.dumps(selector)}, {json.dumps(property_)})")
            for selector, property_ in ((text, what), (under, grounds))
        ]
        assert (max(pair) + 0.05) / (min(pair) + 0.05) >= 4.5, text
