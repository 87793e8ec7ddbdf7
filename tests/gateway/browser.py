"""Headless Chromium over the DevTools protocol, with the commands that tests of pages need."""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE = 30.0
"""Timeout in seconds."""


def executable() -> str | None:
    """The path of the browser; None if there is none."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


class Browser:
    """A running browser, in which pages are opened; `profile` is an empty folder."""

    def __init__(self, program: str, profile: Path) -> None:
        flags = ("--headless=new", "--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={profile}")
        quiet = ("--no-first-run", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage")
        log = (profile / "log.txt").open("wb")
        with log:
            self._process = subprocess.Popen([program, *flags, *quiet, "about:blank"], stdout=log, stderr=log)
        self._stack = contextlib.ExitStack()
        self._connection = self._stack.enter_context(self._connect(profile / "DevToolsActivePort"))
        self._ids = itertools.count(1)
        self.events: list[dict[str, Any]] = []

    def _connect(self, file: Path) -> contextlib.AbstractContextManager[ClientConnection]:
        """Wait for the file in which the browser writes its port and path when it is ready, and connect."""
        until = time.monotonic() + PATIENCE
        while not (file.exists() and file.read_text(encoding="ascii").count("\n")):
            assert self._process.poll() is None, "the browser has ended"
            assert time.monotonic() < until, "the browser does not start"
            time.sleep(0.05)
        port, path = file.read_text(encoding="ascii").splitlines()
        return connect(f"ws://127.0.0.1:{port}{path}", max_size=None, proxy=None, open_timeout=PATIENCE)

    def call(self, method: str, session: str | None = None, /, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its answer. Events in between are stored in `events`."""
        number = next(self._ids)
        request = {"id": number, "method": method, "params": parameters}
        self._connection.send(json.dumps(request if session is None else {**request, "sessionId": session}))
        while True:
            answer = json.loads(self._connection.recv(timeout=PATIENCE))
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result
            self.events.append(answer)

    def open(self, url: str, width: int = 1366, height: int = 768) -> Page:
        """Open a page in front of all others, with a laptop's size; as on a phone if it is narrow."""
        target = self.call("Target.createTarget", url="about:blank", newWindow=True)["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, session, target)
        for domain in ("Page", "Runtime", "Log"):
            page.call(f"{domain}.enable")
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        page.call("Emulation.setDeviceMetricsOverride", **metrics)
        page.call("Emulation.setFocusEmulationEnabled", enabled=True)
        page.go(url)
        return page

    def close(self) -> None:
        self.call("Browser.close")  # a signal would leave its files behind
        self._stack.close()
        self._process.wait(PATIENCE)


class Page:
    """A page of a browser. Expressions are JavaScript."""

    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self._browser = browser
        self._session = session
        self._target = target

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._browser.call(method, self._session, **parameters)

    def go(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.until(f"document.readyState === 'complete' && location.href.startsWith({json.dumps(url)})")

    def evaluate(self, expression: str) -> Any:
        """The value of an expression, as JSON. An exception in the page is raised here."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, f"{expression}: {answer['exceptionDetails']}"
        return answer["result"].get("value")

    def until(self, expression: str) -> Any:
        """Wait until the expression is true, and return its value."""
        until = time.monotonic() + PATIENCE
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < until, f"never: {expression}\n{self.evaluate('document.body.innerText')}"
            time.sleep(0.03)
        return value

    def text(self, selector: str) -> str:
        """The visible text."""
        return str(self.evaluate(f"document.querySelector({json.dumps(selector)}).innerText"))

    def press_mouse(self, selector: str) -> None:
        self._mouse("mousePressed", selector)

    def release_mouse(self, selector: str) -> None:
        self._mouse("mouseReleased", selector)

    def click(self, selector: str) -> None:
        self.press_mouse(selector)
        self.release_mouse(selector)

    def _mouse(self, kind: str, selector: str) -> None:
        element = f"document.querySelector({json.dumps(selector)})"
        self.until(f"{element}?.checkVisibility() ?? false")
        self.evaluate(f"{element}.scrollIntoView({{block: 'nearest'}})")
        box = self.evaluate(f"{element}.getBoundingClientRect().toJSON()")
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, key: str) -> None:
        """Press and release one key, named as in KeyboardEvent.key."""
        text = {"text": "\r"} if key == "Enter" else {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, **(text if kind == "keyDown" else {}))

    def type(self, selector: str, text: str) -> None:
        """Replace the text in the field by typing."""
        self.click(selector)
        self.evaluate(f"document.querySelector({json.dumps(selector)}).select()")
        self.call("Input.insertText", text=text)

    def prefer(self, scheme: str) -> None:
        """Set the preferred colour scheme, `light` or `dark`."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def complaints(self) -> list[str]:
        """Errors and exceptions that the browser has reported for this page, except a refused icon."""
        self.evaluate("0")
        mine = [event for event in self._browser.events if event.get("sessionId") == self._session]
        logged = [event["params"]["entry"] for event in mine if event["method"] == "Log.entryAdded"]
        errors = [f"{entry['text']} {entry.get('url', '')}" for entry in logged if entry["level"] == "error"]
        thrown = [
            str(event["params"]["exceptionDetails"]) for event in mine if event["method"] == "Runtime.exceptionThrown"
        ]
        return [error for error in errors if "favicon" not in error] + thrown

    def close(self) -> None:
        self._browser.call("Target.closeTarget", targetId=self._target)
