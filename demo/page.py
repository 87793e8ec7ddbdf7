"""Opens the gateway page late, as a websocket client, and collects what it shows."""

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
"""Seconds to wait for the latest values, which the gateway sends at once."""


class Shown(NamedTuple):
    """Whether there was a page; the topics with data; those of them whose data came before the schema of the type."""

    has_page: bool = False
    topics: frozenset[str] = frozenset()
    early: frozenset[str] = frozenset()


def look(address: Address, wanted: Collection[str]) -> Shown:
    """Open page and websocket, and read until all `wanted` topics have arrived or PATIENCE is over."""
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
    """Yield documents until PATIENCE is over. Raises OSError, WebSocketException."""
    deadline = time.monotonic() + PATIENCE
    with connect(f"ws://{address}/", open_timeout=PATIENCE, max_size=None, proxy=None) as opened:
        while (left := deadline - time.monotonic()) > 0:
            try:
                text = opened.recv(timeout=left)
            except TimeoutError:
                return
            yield from map(json.loads, str(text).split("\n"))
