"""The checks of tests/gateway/accessibility.py find what is wrong, and nothing in a page that is right."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import quote

import pytest

from tests.gateway import accessibility
from tests.gateway.browser import Browser, Page

pytestmark = pytest.mark.slow

GOOD = """<html lang=en><title>t</title><style>
  body { background: #fff; color: #333; font: 15px sans-serif; } button { min-height: 30px; }
  button:focus-visible { outline: 3px solid blue; }
</style><p>Text</p><button>Named</button><label>Word <input style="height: 30px"></label>
<svg width=100 height=40><rect width=100 height=40 fill="#000" /><text x=5 y=20 fill="#fff">drawn</text></svg>"""

FAULTS: list[tuple[Callable[[Page], list[str]], str]] = [
    (accessibility.contrast_problems, "<p style='color: #999'>pale</p>"),
    (accessibility.contrast_problems, "<div style='opacity: .5'><p>faded</p></div>"),
    (accessibility.contrast_problems, "<p style='background: #333'><b>on dark</b></p>"),
    (accessibility.contrast_problems, "<svg><rect width=100 height=40 fill='#222' /><text y=20>drawn</text></svg>"),
    (accessibility.unnamed_controls, "<button style='width: 40px'></button>"),
    (accessibility.unnamed_controls, "<input style='height: 30px'>"),
    (accessibility.unnamed_controls, "<svg tabindex=0 role=button width=30 height=30></svg>"),
    (accessibility.overflows, "<div style='width: 3000px'>wide</div>"),
    (accessibility.cut_texts, "<div style='width: 30px; overflow: hidden; white-space: nowrap'>much longer</div>"),
    (accessibility.small_texts, "<p style='font-size: 9px'>tiny</p>"),
    (accessibility.small_texts, "<svg width=100 height=50 viewBox='0 0 200 100'><text y=50>shrunk</text></svg>"),
    (
        accessibility.small_targets,
        "<style>i { display: block; height: 12px; }</style><i tabindex=0>a</i><i tabindex=0>b</i>",
    ),
    (accessibility.hidden_focus, "<button style='outline: none'>no ring</button>"),
]


def open_page(browser: Browser, document: str) -> Page:
    page = browser.open("about:blank")
    page.evaluate(f"document.open(), document.write(decodeURIComponent('{quote(document)}')), document.close()")
    return page


@pytest.mark.parametrize("size", accessibility.SIZES, ids=str)
def test_a_good_page_has_no_problems(browser: Browser, size: tuple[int, int]) -> None:
    page = open_page(browser, GOOD)
    accessibility.show_at(page, size, "light")
    assert accessibility.problems(page) + accessibility.cut_texts(page) == []
    page.close()


@pytest.mark.parametrize(("check", "fault"), FAULTS, ids=lambda each: getattr(each, "__name__", ""))
def test_a_fault_is_found(browser: Browser, check: Callable[[Page], list[str]], fault: str) -> None:
    page = open_page(browser, GOOD + fault)
    assert check(page), fault
    page.close()
