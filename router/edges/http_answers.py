"""What is answered over HTTP, but for taps: metrics, health, the page, and what a router is told to do.

Knows no connection; who may ask is not its business.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import choose_encoder

from router.edges.page_policy import page_policy
from router.edges.running import Running
from router.edges.status import Status
from router.errors import RouterError

PAGE = Path(__file__).with_name("status_page.html")

STUCK_SECONDS = 2.0
"""The receive thread is stuck when it does not get further for so long; it takes 0.5 s where nothing comes."""

LOOK_SECONDS = 0.05

TEXT, JSON, HTML = "text/plain; charset=utf-8", "application/json", "text/html; charset=utf-8"
_NO_RECORDING = "the table keeps nothing to save; it would with 'record: {last: 60s}'"

Query = Mapping[str, Sequence[str]]


class Answer(NamedTuple):
    status: HTTPStatus
    kind: str
    body: bytes
    headers: Mapping[str, str] = {}


def text(status: HTTPStatus, line: str) -> Answer:
    return Answer(status, TEXT, f"{line}\n".encode())


def _json(status: HTTPStatus, said: Mapping[str, Any]) -> Answer:
    return Answer(status, JSON, json.dumps(said).encode())


class Answers:
    """What is answered to each request; knows no connection."""

    def __init__(self, running: Running, status: Status, save: Callable[[str], Path] | None) -> None:
        self.running = running
        self._status = status
        self._save = save
        self._registry = CollectorRegistry()
        self._registry.register(running)
        ProcessCollector(registry=self._registry)
        page = PAGE.read_bytes()
        policy = f"{page_policy(page)}; connect-src 'self'"
        self._page = Answer(HTTPStatus.OK, HTML, page, {"Content-Security-Policy": policy})
        self._get: Mapping[str, Callable[[Query], Answer]] = {
            "/": lambda _: self._page,
            "/status.json": lambda _: _json(HTTPStatus.OK, self._status.numbers()),
            "/map.json": self._map,
            "/healthz": lambda _: self._healthz(),
            "/ready": lambda _: self._ready(),
        }
        self._post = {"/-/reload": self._reload, "/record/save": self._save_recording}

    def get(self, path: str, query: Query) -> Answer:
        if path in self._get:
            return self._get[path](query)
        if path in self._post:
            return text(HTTPStatus.METHOD_NOT_ALLOWED, f"{path} is an order: POST")
        return text(HTTPStatus.NOT_FOUND, "there are /, /metrics, /healthz, /ready and /tap")

    def metrics(self, accepts: str) -> Answer:
        encode, kind = choose_encoder(accepts)
        return Answer(HTTPStatus.OK, kind, encode(self._registry))

    def post(self, path: str) -> Answer:
        if path in self._post:
            return self._post[path]()
        return text(HTTPStatus.NOT_FOUND, f"there are {' and '.join(self._post)}")

    def _map(self, query: Query) -> Answer:
        try:
            return _json(HTTPStatus.OK, self._status.map(query.get("width", ["wide"])[0]))
        except KeyError as error:
            return text(HTTPStatus.BAD_REQUEST, f"there is no width {error}: narrow, wide")

    def _healthz(self) -> Answer:
        before, until = self.running.progress(), monotonic() + STUCK_SECONDS
        while monotonic() < until:
            if self.running.progress() != before:
                return text(HTTPStatus.OK, "ok")
            sleep(LOOK_SECONDS)
        return text(HTTPStatus.SERVICE_UNAVAILABLE, f"the receive thread is stuck, for {STUCK_SECONDS:g} s at least")

    def _ready(self) -> Answer:
        if self.running.is_ready:
            return text(HTTPStatus.OK, "ready")
        return text(HTTPStatus.SERVICE_UNAVAILABLE, "not ready: starting or stopping")

    def _reload(self) -> Answer:
        result = self.running.reload()
        said = {"ok": result.ok, "text": result.text, "findings": [str(finding) for finding in result.findings]}
        return _json(HTTPStatus.OK if result.ok else HTTPStatus.UNPROCESSABLE_ENTITY, said)

    def _save_recording(self) -> Answer:
        if self._save is None:
            return _json(HTTPStatus.NOT_FOUND, {"ok": False, "text": _NO_RECORDING})
        try:
            return _json(HTTPStatus.OK, {"ok": True, "file": str(self._save("http"))})
        except RouterError as error:
            return _json(HTTPStatus.CONFLICT, {"ok": False, "text": str(error)})
