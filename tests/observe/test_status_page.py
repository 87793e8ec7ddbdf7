"""The status page of a running router, in a real browser, as a person uses it in the field."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from router.clock import boottime_ns
from router.compiler import check_table
from router.observe import responses
from router.observe.snapshot import quantile
from tests.gateway import accessibility
from tests.gateway.accessibility import DESKTOP, PHONE, SIZES, THEMES
from tests.gateway.browser import Browser, Page
from tests.observe.fake_running import FakeHealth, FakeRunning, served, sim_program
from tests.tables import ROUTES

pytestmark = pytest.mark.slow

BOARD = ("127.0.0.30", 25008)
LONG_AGO = 1
"""In ns: an endpoint that was heard, and then no more."""


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeRunning]:
    """All endpoints were heard just now, and the page asks ten times as often."""
    monkeypatch.setattr(responses, "KEPT_SECONDS", 0)
    page = responses.PAGE.read_text(encoding="utf-8")
    for slow in ("const PERIOD = 1000;", "const PERIOD_HIDDEN = 10000;"):
        assert slow in page
        page = page.replace(slow, f"{slow.partition('=')[0]}= 100;")
    hasty = tmp_path / "page.html"
    hasty.write_text(page, encoding="utf-8")
    monkeypatch.setattr(responses, "PAGE", hasty)
    opened = FakeRunning(sim_program())
    for endpoint in opened.program.table.endpoints:
        opened.count("endpoint_silence_seconds", endpoint, to=2**62)
    opened.count("config_last_reload_successful", to=1)
    yield opened
    opened.mirror.close()
    assert opened.failures == []


@pytest.fixture
def health(running: FakeRunning) -> FakeHealth:
    return FakeHealth(running)


@pytest.fixture
def url(running: FakeRunning, health: FakeHealth) -> Iterator[str]:
    with closing(served(running, save, health=health)) as server:
        yield f"http://{server.address}/"


def save(reason: str) -> Path:
    return Path("/var/lib/recordings/last.mcap")


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


def until_said(page: Page, what: str, level: str) -> None:
    """The banner says so."""
    page.until(f"document.querySelector('#what').textContent.includes({json.dumps(what)})")
    assert page.evaluate("document.querySelector('#banner').className") == level


def until_compared(page: Page) -> None:
    page.until("answers.length > 1")


def test_the_map_shows_the_whole_table(page: Page) -> None:
    shown = set(page.evaluate("[...nodes.values()].map((node) => node.name)"))
    table = sim_program().table
    assert set(table.endpoints) - {"container_board"} <= shown
    assert {route.case.value for route in table.routes} <= shown
    assert {topic.topic.value for route in table.routes for topic in route.topics} <= shown
    cases = {route.case.value for route in table.routes}
    assert page.evaluate("document.querySelectorAll('.row').length") == len(cases) + len(table.gateways)


def test_the_whole_rover_is_seen_without_scrolling(page: Page) -> None:
    accessibility.show_at(page, DESKTOP)
    assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
    last = max(page.evaluate("[0, 1, 2].flatMap(boxes).map(({element}) => element.getBoundingClientRect().bottom)"))
    assert last <= DESKTOP[1]


OVERLAPPING = """[0, 1, 2].flatMap((column) => boxes(column).flatMap((one, i, all) =>
  all.slice(i + 1).filter((other) => {
    const [a, b] = [one, other].map(({element}) => element.getBoundingClientRect());
    return a.top < b.bottom && b.top < a.bottom;
  }).map((other) => [one.name, other.name])))"""


def test_no_box_overlaps_another_and_lines_end_at_boxes(page: Page) -> None:
    for size in SIZES[1:]:
        accessibility.show_at(page, size)
        assert page.evaluate(OVERLAPPING) == []
        ends = page.evaluate("links.filter((link) => link.element).map((link) => link.line.getAttribute('d'))")
        assert len(ends) > 30
        assert all(path.startswith("M") and "NaN" not in path for path in ends)


def test_an_endpoint_shows_its_rate_its_age_and_its_address(running: FakeRunning, page: Page) -> None:
    until_compared(page)
    running.count("messages_received", "imu_info", "sensor_board", to=500)
    page.until(f"/[0-9]\\/s/.test({box('from:@sensor_board')}.textContent)")
    said = page.evaluate(f"{box('from:@sensor_board')}.innerText")
    assert "127.0.0.30:25008" in said
    assert "heard just now" in said


def test_the_name_of_the_router_is_in_header_and_title(page: Page) -> None:
    assert page.text("h1") == "sim.yaml"
    page.until("document.title === '✓ sim.yaml'")


def test_the_icon_says_how_it_is(running: FakeRunning, page: Page) -> None:
    until_said(page, "All is well", "good")
    well = page.evaluate("document.querySelector('#icon').href")
    running.count("endpoint_silence_seconds", "arm_board", to=LONG_AGO)
    until_said(page, "arm_board is silent", "warn")
    page.until(f"document.querySelector('#icon').href !== {json.dumps(well)}")
    assert page.evaluate("document.querySelector('#icon').href").startswith("data:image/svg+xml,")


def test_it_leads_to_the_gateways_page_and_the_metrics(page: Page) -> None:
    links = page.evaluate("[...document.querySelectorAll('nav a')].map((link) => [link.textContent, link.href])")
    assert links[0] == ["Gateway dashboard", "http://127.0.0.1:28765/"]
    assert links[1][1].endswith("/metrics")


def test_a_table_with_gateways_only_is_shown_as_well(browser: Browser, tmp_path: Path) -> None:
    table = tmp_path / "only.yaml"
    table.write_text("version: 1\ngateways: {headset: {transport: {udp: 127.0.0.9:8502}}}\n")
    program = check_table(table).program
    assert program is not None
    opened = FakeRunning(program)
    opened.count("config_last_reload_successful", to=1)
    with closing(served(opened)) as server:
        page = open_page(browser, f"http://{server.address}/")
        shown = "[0, 1, 2].flatMap(boxes).map((node) => node.name)"
        assert page.evaluate(shown) == ["ROS topics", "headset", "clients of headset"]
        until_said(page, "All is well", "good")
        assert page.evaluate("document.querySelector('#save').checkVisibility()") is False  # it keeps nothing
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


def test_what_is_dropped_is_crossed_and_said_in_words(running: FakeRunning, page: Page) -> None:
    until_said(page, "All is well", "good")
    until_compared(page)
    running.count("messages_dropped", "imu_info", "basestation", "send_error", to=12)
    page.until(f"{line('case:imu_info', 'to:@basestation')}.state === 'dropping'")
    assert page.evaluate(f"{line('case:imu_info', 'to:@basestation')}.cross.checkVisibility()")
    assert "✕ dropping" in page.evaluate(f"{box('case:imu_info')}.innerText")
    until_said(page, "Messages for basestation are dropped: send_error, 12 of imu_info in ", "warn")
    assert page.text("#todo").startswith("basestation does not answer or listen, or the network rejects them")
    page.click("#show")
    page.until("document.querySelector('#name').textContent === 'imu_info'")
    page.until("document.querySelector('#facts').textContent.includes('dropped: 12 send_error')")


def test_what_the_table_holds_back_is_not_wrong(running: FakeRunning, page: Page) -> None:
    page.until("answers.length > 1")
    running.count("messages_dropped", "imu_info", "basestation", "rate_limited", to=12)
    running.count("datagrams_rejected", "rover", "ignored", to=12)
    page.until("sum(targetOf(now(), 'imu_info', 'basestation').dropped) === 12")
    page.until("answers.length > 2")
    until_said(page, "All is well", "good")


def test_what_was_dropped_earlier_is_no_trouble_now(running: FakeRunning, health: FakeHealth, page: Page) -> None:
    running.count("messages_dropped", "imu_info", "basestation", "send_error", to=12)
    until_said(page, "Messages for basestation are dropped", "warn")
    health.begin()
    page.until(f"{line('case:imu_info', 'to:@basestation')}.state === 'dropped'")
    until_said(page, "All is well", "good")


def others(page: Page) -> str:
    return page.text("#others").replace("\n", " ")


def test_what_matters_most_is_said_in_the_banner_and_the_rest_beside_it(running: FakeRunning, page: Page) -> None:
    until_compared(page)
    running.count("endpoint_silence_seconds", "arm_board", to=LONG_AGO)
    running.count("deadman_active", "manual_drive", to=1)
    running.count("deadman_trips", "manual_drive", to=1)
    running.count("config_last_reload_successful", to=0)
    running.count("qos_incompatible", "imu_info", "imu_data", "reliability", to=1)
    running.count("datagrams_rejected", "rover", "unhandled", to=3)
    running.count("unhandled", "arm_diag", to=3)
    until_said(page, "manual_drive is stopped by its deadman: no commands get through", "warn")
    assert page.text("#todo").startswith("Check that they are sent, and more often than")
    assert page.evaluate("document.title") == (
        "! sim.yaml: manual_drive is stopped by its deadman: no commands get through"
    )
    page.until("document.querySelectorAll('#others li').length === 4")
    said = others(page)
    assert "arm_board is silent: last heard " in said
    assert "Check its power, cable or radio, and address: ping 127.0.0.40," in said
    assert "The last reload failed; the old table is still running Run router validate, correct" in said
    assert "arm_diag is received, but no route accepts it, 3 in " in said
    assert "Nothing passes between imu_data and peers with another reliability, 1 of them Compare their QoS" in said


def test_a_listener_without_its_network_is_said_before_what_follows_from_it(running: FakeRunning, page: Page) -> None:
    until_compared(page)
    running.count("endpoint_silence_seconds", "arm_board", to=LONG_AGO)
    running.count("listener_waiting", "rover", to=1)
    until_said(page, "rover receives nothing", "bad")
    assert page.text("#todo").startswith("Bring up the network of 127.0.0.5:25000")
    running.count("listener_waiting", "rover", to=0)
    until_said(page, "arm_board is silent", "warn")


def test_much_that_is_wrong_is_folded(running: FakeRunning, page: Page) -> None:
    until_compared(page)
    for reason in ("queue_full", "stale", "send_error", "mapping_error", "too_large", "non_finite"):
        running.count("messages_dropped", "imu_info", "basestation", reason, to=5)
    page.until("document.querySelector('#fold').textContent === 'Show 2 more'")
    assert page.evaluate("document.querySelectorAll('#others li').length") == 3
    page.click("#fold")
    page.until("document.querySelectorAll('#others li').length === 5")


def test_a_rover_that_is_stopped_is_said_first_with_the_operator_who_is_silent(
    running: FakeRunning, page: Page
) -> None:
    running.count("endpoint_silence_seconds", "arm_board", to=LONG_AGO)
    running.count("endpoint_silence_seconds", "basestation", to=boottime_ns() - 14 * 10**9)
    for route in ("manual_drive", "manual_arm"):
        running.count("deadman_active", route, to=1)
    stopped = "is stopped by its deadman: no commands get through"
    page.until(f"document.querySelector('#what').textContent === 'manual_drive {stopped}, and basestation is silent'")
    assert page.text("#todo").startswith("Check its power, cable or radio, and address: ping 127.0.0.10,")
    assert page.text("#spoken") == f"warning: manual_drive {stopped}"
    page.until("document.querySelectorAll('#others li').length === 3")
    assert re.search(r"basestation is silent: last heard 1[4-9] s ago", others(page))
    assert "■ deadman" in page.evaluate(f"{box('case:manual_drive')}.innerText")
    for key in ("from:@basestation", "to:@basestation"):
        assert "▲ silent" in page.evaluate(f"{box(key)}.innerText")


def test_a_deadman_that_sends_is_drawn_from_its_commands_to_the_board(
    running: FakeRunning, health: FakeHealth, page: Page
) -> None:
    until_compared(page)
    drawn = "links.find((link) => link.isDeadman && link.route === 'manual_drive')"
    is_seen = f"{drawn}.line.checkVisibility() && {drawn}.mark.checkVisibility()"
    assert not page.evaluate(is_seen)
    running.count("deadman_active", "manual_drive", to=1)
    running.count("deadman_datagrams_sent", "manual_drive", "driving_board", to=40)
    page.until(f"{drawn}.state === 'sending' && {is_seen}")
    commands = line("case:manual_drive", "to:@driving_board")
    assert page.evaluate(f"{drawn}.line.getAttribute('d') === {commands}.line.getAttribute('d')")
    assert page.evaluate(f"getComputedStyle({drawn}.line).strokeDasharray") == "3px, 3px"
    page.until(f"/[0-9]\\/s/.test({box('to:@driving_board')}.textContent)")
    choose(page, "case:manual_drive")
    assert "the deadman sends manual_brake" in page.text("#facts")
    health.parked = 27 * 60
    page.until(f"{drawn}.state === 'calm' && {is_seen}")
    running.count("deadman_active", "manual_drive", to=0)
    page.until(f"!({is_seen})")


CLIENT_DEADMEN = """\
version: 1
gateways:
  phone:
    transport: {websocket: 127.0.0.1:28765}
    inbound:
      - {topic: /cmd_vel, type: geometry_msgs/msg/Twist, deadman: {timeout: 500ms, send: {}}}
      - {topic: /arm_vel, type: geometry_msgs/msg/TwistStamped, deadman: {timeout: 500ms, send: {}}}
      - {topic: /horn, type: std_msgs/msg/Bool}
"""


@pytest.fixture
def clients(tmp_path: Path) -> Iterator[FakeRunning]:
    """A router with a gateway on whose topics clients may publish, two of them with a deadman."""
    table = tmp_path / "clients.yaml"
    table.write_text(CLIENT_DEADMEN)
    program = check_table(table).program
    assert program is not None
    opened = FakeRunning(program)
    opened.count("config_last_reload_successful", to=1)
    yield opened
    opened.mirror.close()
    assert opened.failures == []


def test_a_deadman_of_a_client_is_drawn_from_its_gateway_to_its_topic(clients: FakeRunning, browser: Browser) -> None:
    health = FakeHealth(clients)
    drawn, other = (f"links.find((link) => link.route === 'phone:{topic}')" for topic in ("/cmd_vel", "/arm_vel"))
    is_seen = f"{drawn}.line.checkVisibility() && {drawn}.mark.checkVisibility()"
    with closing(served(clients, health=health)) as server:
        page = open_page(browser, f"http://{server.address}/")
        until_compared(page)
        assert page.evaluate("boxes(2).map(({ name }) => name)") == ["clients of phone", "/cmd_vel", "/arm_vel"]
        assert not page.evaluate(is_seen)
        clients.count("messages_published", "phone", "/cmd_vel", to=9)
        clients.count("topic_subscribers", "/cmd_vel", to=1)
        clients.count("deadman_active", "phone:/cmd_vel", to=1)
        clients.count("deadman_datagrams_sent", "phone:/cmd_vel", "/cmd_vel", to=40)
        page.until(f"{drawn}.state === 'sending' && {is_seen}")
        assert page.evaluate(f"{other}.state") == ""
        commands = line("gateway:phone", "to:/cmd_vel")
        assert page.evaluate(f"{drawn}.line.getAttribute('d') === {commands}.line.getAttribute('d')")
        assert "■ deadman" in page.evaluate(f"{box('gateway:phone')}.innerText")
        shown = page.until(f"/[0-9]\\/s/.test({box('to:/cmd_vel')}.innerText) && {box('to:/cmd_vel')}.innerText")
        assert "geometry_msgs/msg/Twist" in shown
        assert "◆ subscribed" in shown
        choose(page, "gateway:phone")
        assert "the deadman publishes" in page.text("#facts")
        assert "■ the deadman publishes to /cmd_vel" in page.text("#facts")
        assert page.evaluate("nodes.get('gateway:phone').words.children.length") == 3
        choose(page, "clients:gateway:phone")
        assert page.evaluate(f"{drawn}.element.classList.contains('near')")
        health.parked = 27 * 60
        page.until(f"{drawn}.state === 'calm' && {is_seen}")
        assert page.complaints() == []
        page.close()


def test_a_box_that_grows_moves_those_below_it(clients: FakeRunning, browser: Browser) -> None:
    with closing(served(clients)) as server:
        page = open_page(browser, f"http://{server.address}/", (1920, 1080))
        assert page.evaluate(OVERLAPPING) == []
        page.evaluate(f"{box('to:gateway:phone')}.querySelector('.more').textContent = 'grows '.repeat(90)")
        page.until(f"{OVERLAPPING}.length === 0")
        assert page.complaints() == []
        page.close()


def test_a_rover_that_nobody_drives_is_calm_and_a_fault_comes_first(
    running: FakeRunning, health: FakeHealth, page: Page
) -> None:
    health.parked = 27 * 60
    running.count("endpoint_silence_seconds", "basestation", to=LONG_AGO)
    running.count("deadman_active", "manual_drive", to=1)
    until_said(page, "manual_drive is halted: no commands for 27 min, and basestation is silent", "")
    assert page.evaluate("document.title") == "□ sim.yaml: manual_drive is halted: no commands"
    assert "□ halted" in page.evaluate(f"{box('case:manual_drive')}.innerText")
    assert page.evaluate("document.querySelectorAll('.silent, .troubled').length") == 0
    sources = len({name for route in running.program.table.routes for name in (each.value for each in route.sources)})
    assert f"{sources - 1} of {sources}" in page.text("#tiles")  # however normal, it is not heard now
    running.count("endpoint_silence_seconds", "arm_board", to=LONG_AGO)
    until_said(page, "arm_board is silent", "warn")
    assert others(page).startswith("□manual_drive is halted: no commands for 27 min, and basestation is silent")


def test_an_endpoint_tells_its_last_silence(running: FakeRunning, page: Page) -> None:
    running.count("endpoint_silences", "arm_board", to=2)
    running.count("endpoint_last_silence_seconds", "arm_board", to=2_340_000_000)
    choose(page, "from:@arm_board")
    words = "; 2 silences since the start, the last of 2.3 s"
    page.until(f"document.querySelector('#facts').textContent.includes({json.dumps(words)})")


def test_before_anything_has_come_the_page_waits(running: FakeRunning, health: FakeHealth, page: Page) -> None:
    for endpoint in running.program.table.endpoints:
        running.count("endpoint_silence_seconds", endpoint, to=0)
    page.until(f"{box('from:@sensor_board')}.innerText.includes('○ not heard yet')")
    running.began = boottime_ns() - 60 * 10**9
    until_said(page, "has not been heard since the router started", "")
    assert page.text("#todo").startswith("All endpoints are silent: check this computer's network")


def test_a_topic_without_a_subscriber_is_a_state_of_its_own(running: FakeRunning, page: Page) -> None:
    until_compared(page)
    running.count("topic_subscribers", "imu_data", to=1)
    running.count("messages_published", "gps_info", "gps_data", to=9)  # it serves late joiners
    page.until(f"/◆imu_data\\s*◇imu.data_raw/.test({box('case:imu_info')}.innerText)")
    page.until(f"{box('case:gps_info')}.innerText.includes('◇')")
    until_said(page, "All is well", "good")
    choose(page, "case:imu_info")
    topics = page.evaluate("nodes.get('case:imu_info').words.innerText").replace("\n", " ")
    assert all(name in topics for name in ("imu_data", "imu/mag", "imu/data_raw", "no subscriber"))
    assert page.evaluate("getComputedStyle(nodes.get('case:gps_info').chip).color") != page.evaluate(
        "getComputedStyle(document.querySelector('#legend .bad')).color"
    )


def test_topics_are_named_as_far_as_there_is_room(page: Page) -> None:
    shown = f"{box('case:imu_info')}.querySelector('.chip').innerText"
    for size, text in (
        ((1920, 1080), "^◇imu_data◇imu/data_raw◇imu/mag$"),
        ((1366, 768), r"^◇imu_data.*\+[12]$"),
        ((800, 600), "^◇3$"),
        (PHONE, "^◇imu_data"),
    ):
        accessibility.show_at(page, size)
        page.until(f"/{text.replace('/', '.')}/.test({shown})")
    accessibility.show_at(page, DESKTOP)
    assert page.evaluate(f"{box('case:drive_motor')}.innerText.includes('←drive_motor')")


LONG = "vehicle/front_left_wheel_module/suspension_actuator_temperature/raw_measurement"


def test_a_long_name_of_a_topic_is_shortened_to_the_room(page: Page) -> None:
    page.evaluate(f"nodes.get('to:gps_data').name = {json.dumps(LONG)}")
    chip = f"{box('case:gps_info')}.querySelector('.chip')"
    for size in ((1366, 768), PHONE):
        accessibility.show_at(page, size)
        page.until(f"/^◇veh[^+]*…[^+]*ent/.test({chip}.innerText)")
        assert page.evaluate(f"{chip}.scrollWidth <= {chip}.clientWidth")


def test_the_legend_says_since_when_rates_are_known(page: Page) -> None:
    until_compared(page)
    assert re.fullmatch(r"last \d+(\.\d)? s", page.text("#known"))
    page.evaluate("answers.unshift({...answers[0], at: now().at - 61}); renderMap()")
    assert page.text("#known") == "last minute"


def test_latencies_are_those_of_router_top(page: Page) -> None:
    counts = {0.001: 10.0, 0.002: 40.0, 0.004: 99.0, math.inf: 100.0}
    for part in (0.05, 0.5, 0.99, 1):
        in_page = page.evaluate(f"quantile([[.001, 10], [.002, 40], [.004, 99], [Infinity, 100]], {part})")
        assert (math.inf if in_page is None else in_page) == pytest.approx(quantile(counts, part))


def test_a_laptops_screen_has_room_for_the_name_of_a_topic_in_each_row(page: Page) -> None:
    accessibility.show_at(page, (1366, 768))
    unnamed = "boxes(1).filter(({ chip }) => !chip.hidden && !/[a-z]/.test(chip.innerText)).map(({ name }) => name)"
    assert page.evaluate("boxes(1).filter(({ chip }) => !chip.hidden).length") > 20
    page.until(f"{unnamed}.length === 0")


def test_a_minute_of_rates_begins_without_a_peak(
    running: FakeRunning, health: FakeHealth, browser: Browser, url: str
) -> None:
    running.count("messages_received", "imu_info", "sensor_board", to=100_000)
    health.begin()
    page = open_page(browser, url)
    shown = f"rates(passed({line('from:@sensor_board', 'case:imu_info')}))"
    spark = f"{box('case:imu_info')}.querySelector('.spark path:last-child').getAttribute('d')"
    page.until(f"{shown}.length > 3")
    assert page.evaluate(f"Math.max(...{shown}.map(([, value]) => value))") == 0
    assert not page.evaluate(spark)
    running.count("messages_received", "imu_info", "sensor_board", to=100_050)
    page.until(f"{shown}.at(-1)[1] > 0")
    page.until(f"{spark}.startsWith('M')")
    page.close()


def test_a_page_saves_the_last_minute_and_says_in_which_file(page: Page) -> None:
    assert page.text("#save") == "Save the last minute"
    page.click("#save")
    page.until("document.querySelector('#saved').textContent.startsWith('✓')")
    assert page.text("#saved") == "✓ Saved as last.mcap in the router's recordings"
    page.until("!document.querySelector('#save').disabled")
    page.click("#save")
    page.until("document.querySelector('#saved').textContent.startsWith('!')")
    assert "a recording has just been saved: try again in " in page.text("#saved")
    assert "/var/lib" not in page.text("body")
    refused = [text for text in page.complaints() if "429" in text]
    page._browser.events.clear()
    assert len(refused) == 1


def test_a_case_shows_its_numbers_and_its_last_value(running: FakeRunning, page: Page) -> None:
    running.count("messages_received", "imu_info", "sensor_board", to=1234)
    running.count("messages_filtered", "imu_info", "imu_data", to=34)
    choose(page, "case:imu_info")
    data = running.program.envelopes.first.message_class(imu_info={"accel_x": 1.5}).SerializeToString()
    running.receive(data, BOARD)
    page.until("document.querySelector('#value')?.textContent.includes('accel_x: 1.5')")
    page.until("document.querySelector('#facts').textContent.includes('1\\u202f234')")
    assert "from sensor_board" in page.text("#facts")
    assert "no subscriber (34 filtered)" in page.text("#facts")


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
    table = tmp_path / HOSTILE
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "hostile.proto").write_text(HOSTILE_PROTO)
    table.write_text(HOSTILE_TABLE)
    program = check_table(table).program
    assert program is not None
    return FakeRunning(program)


def test_texts_of_payloads_and_names_are_text_and_nothing_else(
    running: FakeRunning, hostile: FakeRunning, browser: Browser
) -> None:
    inner = {"text": HOSTILE, "words": {HOSTILE: HOSTILE, "__proto__": HOSTILE}}
    note: dict[str, object] = {"text": HOSTILE, "data": HOSTILE.encode(), "lines": [HOSTILE] * 2}
    note |= {"inner": inner, "inners": [inner], "table": {HOSTILE: inner}}
    cases = ("note", "constructor", "__proto__", "toString")
    with closing(served(hostile)) as server:
        page = open_page(browser, f"http://{server.address}/#%")
        assert HOSTILE in page.text("h1")
        for case in cases:
            choose(page, f"case:{case}")
            assert "None received" in page.text("#facts")
            hostile.receive(
                hostile.program.envelopes.first.message_class(**{case: note}).SerializeToString(), ("127.0.0.2", 8)
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


TILES = "[...document.querySelectorAll('#tiles dd > span')].map((each) => each.textContent)"


def test_rates_are_there_with_the_first_answer(browser: Browser, running: FakeRunning, health: FakeHealth) -> None:
    with closing(served(running, health=health)) as server:
        time.sleep(0.6)  # the router has counted before the page opens
        running.count("messages_received", "imu_info", "sensor_board", to=600)
        running.count("datagrams_received", "rover", to=600)
        page = browser.open("about:blank")
        hold = "const get = window.fetch; let asked = 0; window.fetch = (path, ...more) => "
        once = "path === 'status.json' && asked++ ? new Promise(() => {}) : get(path, ...more);"
        page.call("Page.addScriptToEvaluateOnNewDocument", source=hold + once)
        page.go(f"http://{server.address}/")
        page.until("document.querySelector('#state').textContent === 'running'")
        assert page.evaluate("asked") >= 1  # and answered once
        assert page.evaluate(f"{TILES}[0]") not in ("\N{EM DASH}", "0/s")
        assert page.evaluate(f"{box('case:imu_info')}.innerText").endswith("/s")
        page.close()


def test_what_nobody_counted_is_not_drawn_as_zero(page: Page) -> None:
    page.until("answers.length > 1")
    start = f"parseFloat({box('case:imu_info')}.querySelector('.base').getAttribute('d').slice(1))"
    page.evaluate("take({ ...now(), at: now().at + 20 }, []); render()")
    assert 30 < page.evaluate(start) < 40  # of 60 s
    page.evaluate("answers = [now()]; render()")
    assert page.evaluate(f"{box('case:imu_info')}.querySelector('.base').getAttribute('d')") == ""


def test_where_nothing_can_be_compared_no_rate_is_told(page: Page) -> None:
    page.until("answers.length > 1")
    first = page.evaluate(f"answers = [now()]; render(); {TILES}")
    assert first == ["\N{EM DASH}", "\N{EM DASH}", "4 of 4", "\N{EM DASH}", "\N{EM DASH}", "\N{EM DASH}"]
    page.until(f"answers.length > 1 && {TILES}[0] === '0/s'")
    assert page.evaluate(TILES) == ["0/s", "0/s", "4 of 4", "0", "0", "0"]


def test_pointing_shows_for_a_moment_and_clicking_keeps(page: Page) -> None:
    page.evaluate(f"{box('case:imu_info')}.dispatchEvent(new PointerEvent('pointerenter', {{pointerType: 'mouse'}}))")
    assert page.text("#name") == "imu_info"
    page.evaluate(f"{box('case:imu_info')}.dispatchEvent(new PointerEvent('pointerleave', {{pointerType: 'mouse'}}))")
    assert page.text("#name") == "Details"
    choose(page, "from:@sensor_board")
    assert page.evaluate("location.hash") == "#from%3A%40sensor_board"
    page.key("Escape")
    assert page.text("#name") == "Details"


def test_a_reload_without_the_chosen_route_closes_its_details_and_one_with_it_opens_them(page: Page) -> None:
    choose(page, "case:imu_info")
    page.evaluate(f"{box('case:imu_info')}.dispatchEvent(new PointerEvent('pointerenter', {{pointerType: 'mouse'}}))")
    without = """
      const key = "case:imu_info";
      const nodes = map.nodes.filter((node) => node.key !== key);
      const links = map.links.filter(({ start, end }) => start !== key && end !== key);
      show({ ...now(), map: "other" }, { ...map, map: "other", nodes, links }, []);
      [chosen, pointedAt, document.querySelector("#name").textContent]"""
    assert page.evaluate(f"{{{without}}}") == [None, None, "Details"]
    page.until("document.querySelector('#name').textContent === 'imu_info'")
    assert page.evaluate(f"{box('case:imu_info')}.getAttribute('aria-expanded')") == "true"


def test_the_keyboard_reaches_every_box_and_unfolds_its_topics(page: Page) -> None:
    reached = "[0, 1, 2].flatMap(boxes).every(({element}) => element.tabIndex === 0)"
    assert page.evaluate(reached)
    gps = box("case:gps_info")
    page.evaluate(f"{gps}.focus()")
    page.key("Enter")
    assert page.text("#name") == "gps_info"
    assert page.evaluate(f"{gps}.getAttribute('aria-expanded')") == "true"
    page.until("nodes.get('case:gps_info').words.innerText.includes('gps/fix')")
    page.key("Escape")
    assert page.evaluate(f"{gps}.getAttribute('aria-expanded')") == "false"


def test_a_screen_reader_gets_words_in_place_of_signs(running: FakeRunning, page: Page) -> None:
    until_compared(page)
    running.count("messages_filtered", "gps_info", "gps_data", to=9)
    running.count("endpoint_silence_seconds", "arm_board", to=0)
    page.until(f"{box('case:gps_info')}.ariaLabel === 'gps_info, case, 0 per second, 3 topics, no subscriber'")
    words = "arm_board, source, 127.0.0.40:25008, 0 per second, not heard yet"
    page.until(f"{box('from:@arm_board')}.ariaLabel === {json.dumps(words)}")


def test_a_router_that_ended_is_said_and_one_that_comes_back_is_shown(browser: Browser, running: FakeRunning) -> None:
    server = served(running)
    page = open_page(browser, f"http://{server.address}/")
    until_said(page, "All is well", "good")
    server.close()
    until_said(page, "Connection to the router lost", "bad")
    assert_lost(page)
    with closing(served(running, address=server.address)):
        page.until("document.querySelector('#state').textContent === 'running'")
        until_said(page, "All is well", "good")
        assert page.evaluate("document.body.classList.contains('lost')") is False
        page.close()


def assert_lost(page: Page) -> None:
    """Nobody can take what is shown for what is."""
    assert (page.text("#state"), page.evaluate("document.querySelector('#state').className")) == ("no answer", "bad")
    assert page.evaluate("document.title") == "▲ sim.yaml: connection to the router lost"
    assert "The numbers below are from " in page.text("#todo")
    for selector in ("#tiles", "#flow", "#facts"):
        style = page.evaluate(f"getComputedStyle(document.querySelector('{selector}')).filter")
        assert style == "grayscale(1)"


def test_before_the_first_answer_nothing_is_claimed(browser: Browser, running: FakeRunning, url: str) -> None:
    page = browser.open("about:blank")
    page.call(
        "Page.addScriptToEvaluateOnNewDocument", source="window.fetch = () => new Promise(r => { window.give_up = r; })"
    )
    page.go(url)
    assert (page.text("#state"), page.text("#what")) == ("connecting", "Connecting to the router")
    assert page.evaluate("['#state', '#banner'].map((id) => document.querySelector(id).className)") == ["", ""]
    page.evaluate("give_up(Response.error())")
    until_said(page, "No connection to the router for ", "bad")
    page.close()


def hide(page: Page) -> None:
    page.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")


def test_a_page_in_the_background_says_in_its_title_how_it_is(running: FakeRunning, page: Page) -> None:
    page.until("document.title === '✓ sim.yaml'")
    hide(page)
    page.evaluate("answeredAt -= 5000; renderState()")
    assert page.evaluate("document.title") == "✓ sim.yaml"
    running.count("endpoint_silence_seconds", "arm_board", to=LONG_AGO)
    page.until("document.title === '! sim.yaml: arm_board is silent'")


def test_a_page_that_was_hidden_claims_nothing_before_it_has_asked_again(page: Page) -> None:
    hide(page)
    page.until("next !== 0")
    come_back = "answeredAt -= 60000; delete document.hidden; comeBack();"
    at_once = "[document.body.classList.contains('lost'), document.querySelector('#what').innerText]"
    lost, said = page.evaluate(f"{come_back} {at_once}")
    assert lost
    assert said == "Connection to the router lost 60 s ago"
    until_said(page, "All is well", "good")


def make_well(running: FakeRunning) -> None:
    for number, (route, label) in enumerate([("imu_info", "sensor_board"), ("gps_info", "sensor_board")]):
        running.count("messages_received", route, label, to=100 + number)
    running.count("messages_published", "imu_info", "imu_data", to=100)
    running.count("messages_filtered", "gps_info", "gps/fix", to=100)


def make_trouble(running: FakeRunning) -> None:
    make_well(running)
    running.count("endpoint_silence_seconds", "basestation", to=LONG_AGO)
    running.count("endpoint_silence_seconds", "arm_board", to=0)
    for route in ("manual_drive", "manual_arm"):
        running.count("deadman_active", route, to=1)
    for reason in ("queue_full", "stale", "send_error", "mapping_error"):
        running.count("messages_dropped", "imu_info", "basestation", reason, to=5)
    running.count("datagrams_rejected", "rover", "unhandled", to=3)
    running.count("config_last_reload_successful", to=0)
    running.count("kernel_drops", "rover", to=3)


@pytest.mark.parametrize("state", ["well", "trouble", "lost"])
def test_the_page_is_accessible_at_every_size_in_the_light_and_in_the_dark(
    browser: Browser, running: FakeRunning, state: str
) -> None:
    server = served(running, save)
    with closing(server):
        page = open_page(browser, f"http://{server.address}/")
        until_compared(page)
        (make_well if state == "well" else make_trouble)(running)
        until_said(page, *{"well": ("All is well", "good")}.get(state, ("basestation is silent", "warn")))
    if state == "lost":
        until_said(page, "Connection to the router lost", "bad")
    else:
        page.evaluate("clearTimeout(next), next = 0, hasFailed = false, answeredAt = Infinity")
    found = []
    for size in SIZES:
        for theme in THEMES:
            accessibility.show_at(page, size, theme)
            faults = accessibility.problems(page) + accessibility.cut_texts(page)
            found += [f"{size} {theme} {fault}" for fault in faults]
    assert found == []
    page.close()


STATES = f"""\
version: 1
extends: {ROUTES}/sim.yaml
state:
  mode: {{case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL, valid_for: 5s}}
  selected: {{case: object_selection, source: basestation, value: object_id, initial: 0}}
  driver: {{topic: driver, type: std_msgs/msg/String, value: data, initial: "''"}}
services:
  measure:
    type: std_srvs/srv/Trigger
    request: {{case: rock_measure_result, to: basestation, fields: {{width_cm: "1"}}, ttl: 1s}}
    reply: {{case: rock_measure_request, fields: {{success: "true"}}}}
    timeout: 1s
    on_timeout: {{success: false, message: reason}}
"""


def test_states_and_services_have_tiles_at_every_size(browser: Browser, tmp_path: Path) -> None:
    table = tmp_path / "states.yaml"
    table.write_text(STATES)
    program = check_table(table).program
    assert program is not None
    running = FakeRunning(program)
    running.count("state", "mode", to=1)
    running.count("state_set_seconds", "mode", "basestation", to=boottime_ns())
    running.count("service_calls", "measure", "timed_out", to=2)
    running.texts["driver"] = "the operator on the second floor"
    with closing(served(running, save)) as server:
        page = open_page(browser, f"http://{server.address}/")
        tiles = page.evaluate("[...document.querySelectorAll('#tiles .state')].map((tile) => tile.textContent)")
        found = []
        for size in (*SIZES, (320, 568)):
            accessibility.show_at(page, size)
            found += accessibility.problems(page) + accessibility.cut_texts(page) + accessibility.overflows(page)
        page.close()
    running.mirror.close()
    assert [re.sub(r"[\d.]+ s ago", "N s ago", tile) for tile in tiles] == [
        "service.measure2 timed_out, median over 5 s, some over 5 s",
        "state.modeMODE_AUTOset N s ago by basestation",
        "state.selected0never set",
        "state.driver'the operator on the second floor'never set",
    ]
    assert found == []


@pytest.mark.parametrize("theme", THEMES)
def test_details_and_unfolded_topics_are_accessible(page: Page, running: FakeRunning, theme: str) -> None:
    until_compared(page)
    make_well(running)
    for size in SIZES:
        accessibility.show_at(page, size, theme)
        choose(page, "case:imu_info")
        assert accessibility.problems(page) == []
        page.key("Escape")


def test_nothing_is_wider_than_the_smallest_screen(browser: Browser, url: str) -> None:
    page = open_page(browser, url, (320, 568))
    assert accessibility.overflows(page) == []
    assert accessibility.cut_texts(page) == []
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
