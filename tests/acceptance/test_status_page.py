"""The status page in a real browser while its router, a process, is killed, started again, and stands still."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.acceptance.payloads import generated
from tests.acceptance.site import BARE, RouterProcess, Site, key, site, wait_until
from tests.gateway.browser import Browser, Page

pytestmark = pytest.mark.slow

TABLE = BARE + "routes: {{ph_info: {{source: sensor_board, destinations: [basestation]}}}}\n"
HOSTS = {"sensor_board": "127.0.0.30", "basestation": "127.0.0.10"}
RECEIVED = "[...document.querySelectorAll('#tiles small')][0].textContent"
PH = next(generated("ph_info")).datagram


def until_lost(page: Page) -> None:
    page.until("document.querySelector('#what').textContent.startsWith('Connection to the router lost ')")
    assert page.evaluate("document.querySelector('#banner').className") == "bad"
    assert page.evaluate("document.querySelectorAll('.good').length") == 0


def until_well(page: Page) -> None:
    page.until("document.querySelector('#what').textContent === 'All is well'")
    assert page.text("#state") == "running"
    assert not page.evaluate("document.body.classList.contains('lost')")


def feed(place: Site, datagrams: int) -> None:
    place.send("sensor_board", *[PH] * datagrams)
    received = key("datagrams_received", listener="rover")
    wait_until(lambda: place.scrape()[received] == datagrams, "the datagrams")


def test_a_page_says_that_its_router_is_gone_and_recovers(tmp_path: Path, browser: Browser) -> None:
    with site(tmp_path, HOSTS) as place:
        table = place.table(TABLE)
        table.write_text(table.read_text().replace("kind: board", "kind: board, stale_after: never"))
        with RouterProcess(tmp_path, table) as router:
            feed(place, 30)
            page = browser.open(f"http://127.0.0.1:{place.metrics}/")
            page.until("answers.length > 2")
            until_well(page)
            assert page.evaluate(RECEIVED) == "30 total"
            assert router.stop(signal.SIGKILL) == -signal.SIGKILL
        until_lost(page)
        with RouterProcess(tmp_path, table) as router:  # at the same port, with counters from 0
            feed(place, 40)
            page.until(f"{RECEIVED} === '40 total' && answers.length > 2")
            until_well(page)
            assert page.evaluate("answers.every(({started}) => started === now().started)")  # nothing compares two runs
            router.process.send_signal(signal.SIGSTOP)  # its port goes on taking connections
            try:
                until_lost(page)
            finally:
                router.process.send_signal(signal.SIGCONT)
            until_well(page)
        page.close()
