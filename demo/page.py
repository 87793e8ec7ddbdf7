"""What somebody sees who opens the table's page late: a client of the websocket, as the page is. Knows no verdict."""

from __future__ import annotations

import json
import time
import urllib.request
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from router.table.addresses import Address

PATIENCE = 5.0
"""Seconds in which the latest values must be there; they are sent at once."""


class Shown(NamedTuple):
    """Whether there was a page, of which topics data came, and of which of those before the schema of its type."""

    has_page: bool = False
    topics: frozenset[str] = frozenset()
    early: frozenset[str] = frozenset()


def look(address: Address, wanted: Collection[str]) -> Shown:
    """Opens page and websocket, and watches until all `wanted` topics have come, or it takes too long."""
    introduced, topics, early = set[str](), set[str](), set[str]()
    try:
        with urllib.request.urlopen(f"http://{address}/", timeout=PATIENCE) as answer:
            has_page = b"<html" in answer.read()
        for document in _documents(address):
            if document["op"] == "schema":
                introduced.add(document["type"])
            elif document["op"] == "data":
                topics.add(document["topic"])
                if document["type"] not in introduced:
                    early.add(document["topic"])
            if topics.issuperset(wanted):
                break
    except (OSError, WebSocketException):
        return Shown()
    return Shown(has_page, frozenset(topics), frozenset(early))


def _documents(address: Address) -> Iterator[dict[str, Any]]:
    """Raises OSError, WebSocketException."""
    deadline = time.monotonic() + PATIENCE
    with connect(f"ws://{address}/", open_timeout=PATIENCE, max_size=None, proxy=None) as opened:
        while (left := deadline - time.monotonic()) > 0:
            try:
                text = opened.recv(timeout=left)
            except TimeoutError:
                return
            yield from map(json.loads, str(text).split("\n"))
