"""The responses to HTTP requests, except for taps: metrics, health, the status page, and actions."""

from __future__ import annotations

import gzip
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from http import HTTPStatus
from math import ceil
from pathlib import Path
from time import monotonic
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import choose_encoder

from router.assets import page_policy
from router.clock import boottime_ns
from router.errors import RouterError
from router.observe.problems import Kind
from router.observe.running import Running
from router.observe.snapshot import COLLECTED_AT
from router.observe.status import Status
from router.observe.watch import Health
from router.table.model.settings import HOW_TO_KEEP

PAGE = Path(__file__).with_name("status_page.html")

KEPT_SECONDS = 0.5
"""How long an expensive response is reused for the same request."""

SAVE_SECONDS = 10.0
"""The minimum time between two saves by pages."""

SAVE = "/record/save"

PAGES = frozenset({"/", "/status.json", "/recent.json", "/map.json"})
"""The status page and what it loads: for browsers that opened it at a local address."""

GZIP_FROM = 1000
"""Minimum bytes of a compressed response."""

OPEN_METRICS = "application/openmetrics-text"

TEXT, JSON, HTML = "text/plain; charset=utf-8", "application/json", "text/html; charset=utf-8"
_NO_RECORDING = f"the table keeps no datagrams to save: {HOW_TO_KEEP}"

Query = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Response:
    status: HTTPStatus
    kind: str
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def zipped(self) -> Response:
        """The response, compressed if that is worth it."""
        if len(self.body) < GZIP_FROM:
            return self
        headers = {**self.headers, "Content-Encoding": "gzip"}
        return replace(self, body=gzip.compress(self.body, compresslevel=1), headers=headers)


def plain(status: HTTPStatus, line: str) -> Response:
    return Response(status, TEXT, f"{line}\n".encode())


def _json(status: HTTPStatus, value: Mapping[str, Any]) -> Response:
    return Response(status, JSON, json.dumps(value).encode())


class _Cache:
    """Expensive responses, each made at most every KEPT_SECONDS, and one at a time."""

    def __init__(self) -> None:
        self._responses: dict[str, tuple[float, Response]] = {}  # time of making (monotonic, s), response
        self._making = threading.Lock()

    def get(self, key: str, make: Callable[[], Response]) -> Response:
        with self._making:
            fresh = monotonic() - KEPT_SECONDS
            self._responses = {name: kept for name, kept in self._responses.items() if kept[0] > fresh}
            if key not in self._responses:
                response = make()
                self._responses[key] = monotonic(), response
            return self._responses[key][1]


class Responder:
    """Makes responses. Thread-safe. `save`: see HttpServer."""

    def __init__(self, running: Running, health: Health, status: Status, save: Callable[[str], Path] | None) -> None:
        self.running = running
        self._health = health
        self._status = status
        self._cache = _Cache()
        self._save = save
        self._page_saved = -SAVE_SECONDS  # monotonic, s
        self._page_saving = threading.Lock()
        self._registry = CollectorRegistry()
        self._registry.register(running)
        ProcessCollector(registry=self._registry)
        page = PAGE.read_bytes()
        policy = f"{page_policy(page)}; connect-src 'self'"
        self._page = Response(HTTPStatus.OK, HTML, page, {"Content-Security-Policy": policy})
        self._get: Mapping[str, Callable[[Query], Response]] = {
            "/": lambda _: self._page,
            "/status.json": lambda _: self._cache.get("status", self._numbers),
            "/recent.json": lambda _: self._cache.get("recent", lambda: _json(HTTPStatus.OK, self._status.recent())),
            "/map.json": lambda _: self._map(),
            "/health.json": lambda _: self._cache.get("health", lambda: _json(HTTPStatus.OK, self._status.health())),
            "/healthz": lambda _: self._healthz(),
            "/ready": lambda _: self._ready(),
        }
        self._post = {"/-/reload": self._reload, SAVE: self._save_recording}

    def get(self, path: str, query: Query) -> Response:
        if path in self._get:
            return self._get[path](query)
        if path in self._post:
            return plain(HTTPStatus.METHOD_NOT_ALLOWED, f"{path} requires POST")
        return plain(HTTPStatus.NOT_FOUND, "not found; there are /, /metrics, /healthz and /ready")

    def metrics(self, accepts: str) -> Response:
        """Return the metrics in one of two formats: with more, clients could defeat the cache."""
        accepted = OPEN_METRICS if OPEN_METRICS in accepts else ""
        return self._cache.get(f"metrics {accepted}", partial(self._collected, accepted))

    def _collected(self, accepted: str) -> Response:
        encode, kind = choose_encoder(accepted)
        at = f"{boottime_ns() / 1e9:.6f}"
        return Response(HTTPStatus.OK, kind, encode(self._registry), {COLLECTED_AT: at})

    def _numbers(self) -> Response:
        return _json(HTTPStatus.OK, self._status.numbers())

    def post(self, path: str) -> Response:
        if path in self._post:
            return self._post[path]()
        return plain(HTTPStatus.NOT_FOUND, f"not found; there are {' and '.join(self._post)}")

    def _map(self) -> Response:
        key = f"map {self.running.program.table.sha256}"
        return self._cache.get(key, lambda: _json(HTTPStatus.OK, self._status.map()))

    def _healthz(self) -> Response:
        if self._health.is_stuck:
            return plain(HTTPStatus.SERVICE_UNAVAILABLE, Kind.RECEIVE_STUCK.words)
        return plain(HTTPStatus.OK, "ok")

    def _ready(self) -> Response:
        if self.running.is_ready:
            return plain(HTTPStatus.OK, "ready")
        return plain(HTTPStatus.SERVICE_UNAVAILABLE, "not ready: starting or stopping")

    def _reload(self) -> Response:
        result = self.running.reload()
        body = {"ok": result.ok, "text": result.text, "findings": [str(finding) for finding in result.findings]}
        return _json(HTTPStatus.OK if result.ok else HTTPStatus.UNPROCESSABLE_ENTITY, body)

    def _save_recording(self) -> Response:
        if self._save is None:
            return _json(HTTPStatus.NOT_FOUND, {"ok": False, "text": _NO_RECORDING})
        try:
            return _json(HTTPStatus.OK, {"ok": True, "file": str(self._save("http"))})
        except RouterError as error:
            return _json(HTTPStatus.CONFLICT, {"ok": False, "text": str(error)})

    def save_for_page(self) -> Response:
        """Like POST /record/save, for a page in any browser: at most every SAVE_SECONDS, and without paths."""
        with self._page_saving:
            wait = self._page_saved + SAVE_SECONDS - monotonic()
            if wait > 0 and self._save is not None:
                text = f"a recording has just been saved: try again in {ceil(wait)} s"
                return _json(HTTPStatus.TOO_MANY_REQUESTS, {"ok": False, "text": text})
            self._page_saved = monotonic()
        response = self._save_recording()
        answer = json.loads(response.body)
        if answer["ok"]:
            answer["file"] = Path(answer["file"]).name
        elif (record := self.running.program.table.record) is not None:
            answer["text"] = answer["text"].replace(str(record.directory), record.directory.name)
        return _json(response.status, answer)
