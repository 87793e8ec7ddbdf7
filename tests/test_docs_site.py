"""The documentation as a site: `make docs`."""

from __future__ import annotations

import functools
import http.server
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.gateway.accessibility import SIZES, THEMES, contrast_problems, show_at, unnamed_controls
from tests.gateway.browser import Browser, Page

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parent.parent / "docs"
_OUTSIDE = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*\bsrc=["']?(?:https?:)?//  # what a page loads
    | <link\b(?![^>]*\brel=["']?(?:canonical|author))[^>]*\bhref=["']?(?:https?:)?//
    | \burl\(\s*["']?(?:https?:)?// | @import\s+["'](?:https?:)?//
    | \b(?:fetch|import)\(\s*["'](?:https?:)?//""",
    re.VERBOSE,
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", str(DOCS), str(folder)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


def test_pages_load_nothing_from_outside(site: Path) -> None:
    files = [file for ending in ("html", "css", "js") for file in site.rglob(f"*.{ending}")]
    assert site / "index.html" in files
    found = {str(file.relative_to(site)): _OUTSIDE.findall(file.read_text(encoding="utf-8")) for file in files}
    assert {file: loaded for file, loaded in found.items() if loaded} == {}


def test_each_page_is_in_the_search_index(site: Path) -> None:
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    pages = [str(page.relative_to(DOCS).with_suffix("")) for page in DOCS.rglob("*.md")]
    assert [page for page in pages if f'"{page}"' not in index] == []
    assert '"deadman"' in index


@pytest.fixture(params=["file", "http"])
def address(request: pytest.FixtureRequest, site: Path) -> Iterator[str]:
    if request.param == "file":
        yield site.as_uri()
        return
    handler = functools.partial(QuietHandler, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        serving.join()


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def test_search_finds_a_key(browser: Browser, address: str) -> None:
    page = browser.open(f"{address}/search.html?q=disarmed_by")
    page.until("document.querySelector('#search-results li a[href*=\"reference/keys.html\"]')?.checkVisibility()")
    page.close()


@pytest.mark.parametrize("width", [390, 768, 1440])
def test_no_page_is_wider_than_the_screen(browser: Browser, site: Path, width: int) -> None:
    wide = [name for name in ("index", "reference/keys", "reference/commands") if is_wide(browser, site, name, width)]
    assert wide == []


def is_wide(browser: Browser, site: Path, name: str, width: int) -> bool:
    page: Page = browser.open(f"{site.as_uri()}/{name}.html", width)
    wide = page.evaluate(f"document.documentElement.scrollWidth > {width}")
    page.close()
    return bool(wide)


@pytest.mark.parametrize("name", ["index", "start/first-table", "reference/keys", "search"])
def test_texts_stand_out_and_controls_have_names(browser: Browser, site: Path, name: str) -> None:
    page = browser.open(f"{site.as_uri()}/{name}.html")
    for size in SIZES:
        for theme in THEMES:
            show_at(page, size, theme)
            assert contrast_problems(page) + unnamed_controls(page) == []
    page.close()
