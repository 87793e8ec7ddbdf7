"""What clients of a gateway send, read in turn: what is small at once, all else beside the event loop.

Nothing overtakes what the same client sent on the same topic before.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Union

from router.gateway.context import Tasks
from router.gateway.documents import SchemaRequest
from router.gateway.encoding import Encoding
from router.gateway.inlet import Checked, Inlet, RefusedError
from router.gateway.json_pieces import let_go
from router.gateway.json_reading import InvalidMessageError
from router.gateway.letters import Letter
from router.gateway.packets import PacketError, TooLargeError
from router.gateway.transport.base import Client

MOST_READING = 16 << 20
"""Bytes of JSON that are read beside the loop or wait for that, of all clients. A single message may be longer."""
_LEAST = 1 << 10
"""Bytes that each of them counts as: to wait takes memory as well."""

Understood = Union[Checked, SchemaRequest, RefusedError]
Settle = Callable[[Client, Understood, int], None]
"""Gets a client, what it wants, and when that arrived, in ns of the wall clock."""


class Reader:
    """For the thread of the loop. `settle` is called in it, at once or later."""

    def __init__(self, encoding: Encoding, inlet: Inlet, tasks: Tasks, beside: Executor, settle: Settle) -> None:
        self._encoding = encoding
        self._inlet = inlet
        self._tasks = tasks
        self._beside = beside
        self._settle = settle
        self._bytes = 0
        self._waiting: Counter[tuple[Client, str]] = Counter()  # messages of a client on a topic

    def received(self, client: Client, data: bytes, arrived_ns: int) -> None:
        try:
            letter = self._encoding.letter(data)
            size = self._inlet.admit(letter)
        except (PacketError, InvalidMessageError, RefusedError) as error:
            self._settle(client, _refusal(error), arrived_ns)
            return
        topic = letter.topic or ""
        if letter.is_quick:
            understood = _understood(letter, size, self._inlet)
            if isinstance(understood, Checked):
                topic = understood.topic.plan.label
            if not self._waiting[client, topic]:
                self._settle(client, understood, arrived_ns)
                return
        size = max(size, _LEAST)
        if self._bytes and self._bytes + size > MOST_READING:
            refused = RefusedError("rate_limited", "other large messages are still being read", topic)
            self._settle(client, refused, arrived_ns)
            return
        self._bytes += size
        self._waiting[client, topic] += 1
        self._tasks.run(self._read(client, topic, letter, size, arrived_ns))

    async def _read(self, client: Client, topic: str, letter: Letter, size: int, arrived_ns: int) -> None:
        try:
            understood = await asyncio.get_running_loop().run_in_executor(
                self._beside, _understood, letter, size, self._inlet
            )
        finally:
            self._bytes -= size
            self._waiting -= Counter([(client, topic)])  # which keeps no zero
        self._settle(client, understood, arrived_ns)


def _understood(letter: Letter, most: int, inlet: Inlet) -> Understood:
    """What a client wants. Any thread may ask."""
    try:
        request = letter.read(most)
        if isinstance(request, SchemaRequest):
            return request
        try:
            return inlet.check(request)
        finally:
            if not letter.is_quick:
                let_go(request.data)
    except (PacketError, InvalidMessageError, RefusedError) as error:
        return _refusal(error)


def _refusal(error: PacketError | InvalidMessageError | RefusedError) -> RefusedError:
    match error:
        case RefusedError():
            return error
        case TooLargeError():
            return RefusedError("too_large", str(error))
        case PacketError():
            return RefusedError("malformed", str(error))
        case _:
            return RefusedError("invalid", str(error))
