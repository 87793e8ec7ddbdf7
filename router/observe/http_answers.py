"""What is answered over HTTP, but for taps: metrics, health, the page, and what a router is told to do.

Knows no connection; who may ask is not its business.
"""

from __future__ import annotations

import gzip
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from http import HTTPStatus
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import choose_encoder

from router.assets import page_policy
from router.clock import wall_ns
from router.errors import RouterError
from router.observe.http_callers import COLLECTED_AT
from router.observe.running import Running
from router.observe.status import MEASURES, Status

PAGE = Path(__file__).with_name("status_page.html")

STUCK_SECONDS = 2.0
"""The receive thread is stuck when it does not get further for so long; it takes 0.5 s where nothing comes."""

LOOK_SECONDS = 0.05

KEPT_SECONDS = 0.5
"""For so long an answer that is costly to make is given to whoever asks for the same."""

GZIP_FROM = 1000
"""Bytes of an answer that are worth compressing."""

OPEN_METRICS = "application/openmetrics-text"

TEXT, JSON, HTML = "text/plain; charset=utf-8", "application/json", "text/html; charset=utf-8"
_NO_RECORDING = "the table keeps nothing to save; it would with 'record: {last: 60s}'"

Query = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Answer:
    status: HTTPStatus
    kind: str
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def zipped(self) -> Answer:
        """The same, compressed where that is worth it."""
        if len(self.body) < GZIP_FROM:
            return self
        headers = {**self.headers, "Content-Encoding": "gzip"}
        return replace(self, body=gzip.compress(self.body, compresslevel=1), headers=headers)


def text(status: HTTPStatus, line: str) -> Answer:
    return Answer(status, TEXT, f"{line}\n".encode())


class _Kept:
    """What is costly to make, made at most every KEPT_SECONDS for each key, and one at a time."""

    def __init__(self) -> None:
        self._answers: dict[str, tuple[float, Answer]] = {}  # with when each was made (monotonic, s)
        self._making = threading.Lock()

    def get(self, key: str, make: Callable[[], Answer]) -> Answer:
        with self._making:
            fresh = monotonic() - KEPT_SECONDS
            self._answers = {name: kept for name, kept in self._answers.items() if kept[0] > fresh}
            if key not in self._answers:
                answer = make()
                self._answers[key] = monotonic(), answer
            return self._answers[key][1]


def _json(status: HTTPStatus, said: Mapping[str, Any]) -> Answer:
    return Answer(status, JSON, json.dumps(said).encode())


class Answers:
    """What is answered to each request; knows no connection."""

    def __init__(self, running: Running, status: Status, save: Callable[[str], Path] | None) -> None:
        self.running = running
        self._status = status
        self._kept = _Kept()
        self._save = save
        self._registry = CollectorRegistry()
        self._registry.register(running)
        ProcessCollector(registry=self._registry)
        page = PAGE.read_bytes()
        policy = f"{page_policy(page)}; connect-src 'self'"
        self._page = Answer(HTTPStatus.OK, HTML, page, {"Content-Security-Policy": policy})
        self._get: Mapping[str, Callable[[Query], Answer]] = {
            "/": lambda _: self._page,
            "/status.json": lambda _: self._kept.get("status", self._numbers),
            "/map.json": self._map,
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
        """In one of two formats: versions and escapings, which callers may make up, would each be encoded anew."""
        asked = OPEN_METRICS if OPEN_METRICS in accepts else ""
        return self._kept.get(f"metrics {asked}", partial(self._collected, asked))

    def _collected(self, asked: str) -> Answer:
        encode, kind = choose_encoder(asked)
        at = f"{wall_ns() / 1e9:.6f}"
        return Answer(HTTPStatus.OK, kind, encode(self._registry), {COLLECTED_AT: at})

    def _numbers(self) -> Answer:
        return _json(HTTPStatus.OK, self._status.numbers())

    def post(self, path: str) -> Answer:
        if path in self._post:
            return self._post[path]()
        return text(HTTPStatus.NOT_FOUND, f"there are {' and '.join(self._post)}")

    def _map(self, query: Query) -> Answer:
        width = query.get("width", ["wide"])[0]
        if width not in MEASURES:
            return text(HTTPStatus.BAD_REQUEST, f"there is no width '{width}': narrow, wide")
        key = f"map {width} {self.running.program.table.sha256}"
        return self._kept.get(key, lambda: _json(HTTPStatus.OK, self._status.map(width)))

    def healthz(self) -> Answer:
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
