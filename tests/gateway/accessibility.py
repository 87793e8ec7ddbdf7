"""Checks of a page in the headless browser: contrast, names of controls, sizes, and overflow.

Each check returns one string per problem. Checks see only what is visible: unfold sections, and choose size and theme
(`show_at`), before.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.gateway.browser import Page

PHONE, TABLET, DESKTOP = (390, 844), (768, 1024), (1440, 900)
SIZES = (PHONE, TABLET, DESKTOP)
THEMES = ("dark", "light")

CONTRAST, CONTRAST_OF_LARGE = 4.5, 3.0
"""WCAG 2.2 AA, 1.4.3."""
SMALLEST_TEXT = 11.0
"""CSS pixels."""
SMALLEST_TARGET = 24.0
"""CSS pixels; WCAG 2.2 AA, 2.5.8. A smaller target is allowed if a circle of this size contains no other target."""

_CHECKS = Path(__file__).with_suffix(".js").read_text(encoding="utf-8").partition("*/")[2].strip()
_CONTROLS = (
    'a[href], button, input:not([type=hidden]), select, textarea, summary, [tabindex]:not([tabindex="-1"]), '
    "[role=button], [role=link], [role=tab], [role=option], [role=checkbox], [role=switch]"
)
_NAMED_ROLES = {
    "button", "link", "textbox", "searchbox", "combobox", "checkbox", "radio", "slider", "spinbutton", "switch", "tab",
    "menuitem", "option", "listbox", "image", "img", "dialog", "DisclosureTriangle",
}  # fmt: skip


def show_at(page: Page, size: tuple[int, int], theme: str | None = None) -> None:
    """Show the page on a screen of this size, as a phone if it is narrow, `dark` or `light`."""
    width, height = size
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500)
    if theme is not None:
        page.prefer(theme)
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")


def contrast_problems(page: Page) -> list[str]:
    """Texts with too little contrast to their background; disabled controls are exempt."""
    return _found(page, "contrast", OF_TEXT=CONTRAST, OF_LARGE=CONTRAST_OF_LARGE)


def unnamed_controls(page: Page) -> list[str]:
    """Controls and pictures without an accessible name, as computed by the browser."""
    page.call("Accessibility.enable")
    try:
        tree = page.call("Accessibility.getFullAXTree")["nodes"]
        return [_described(page, node) for node in tree if _needs_name(node) and not _value(node, "name")]
    finally:
        page.call("Accessibility.disable")


def overflows(page: Page) -> list[str]:
    """Elements that extend beyond the left or right edge, so that the page scrolls sideways."""
    return _found(page, "overflows")


def cut_texts(page: Page) -> list[str]:
    """Texts that are cut off by their element."""
    return _found(page, "cut")


def small_texts(page: Page, least: float = SMALLEST_TEXT) -> list[str]:
    return _found(page, "smallTexts", LEAST=least)


def small_targets(page: Page, least: float = SMALLEST_TARGET) -> list[str]:
    """Controls that are too small to hit; links within a text are exempt."""
    return _found(page, "smallTargets", LEAST=least)


def hidden_focus(page: Page) -> list[str]:
    """Controls that do not take the keyboard focus, or do not show it."""
    return _found(page, "focus")


def problems(page: Page) -> list[str]:
    """The problems found by all checks."""
    checks = (contrast_problems, unnamed_controls, overflows, small_texts, small_targets, hidden_focus)
    return [f"{check.__name__}: {found}" for check in checks for found in check(page)]


def _found(page: Page, check: str, **limits: float) -> list[str]:
    arguments = json.dumps({"CHECK": check, "CONTROLS": _CONTROLS, **limits})
    found: list[str] = page.evaluate(f"({_CHECKS})({arguments})")
    return found


def _needs_name(node: dict[str, Any]) -> bool:
    if node.get("ignored") or _value(node, "role") == "RootWebArea":
        return False
    return _value(node, "role") in _NAMED_ROLES or any(_true_properties(node, "focusable"))


def _true_properties(node: dict[str, Any], name: str) -> Iterator[bool]:
    return (True for each in node.get("properties", ()) if each["name"] == name and each["value"].get("value"))


def _value(node: dict[str, Any], key: str) -> str:
    return str(node.get(key, {}).get("value", "")).strip()


def _described(page: Page, node: dict[str, Any]) -> str:
    found = page.call("DOM.describeNode", backendNodeId=node["backendDOMNodeId"])["node"]
    pairs = zip(found.get("attributes", [])[::2], found.get("attributes", [])[1::2], strict=True)
    attributes = "".join(f' {name}="{value}"' for name, value in pairs if name in ("id", "class", "type"))
    return f"<{found['localName']}{attributes}>: {_value(node, 'role')} without a name"
