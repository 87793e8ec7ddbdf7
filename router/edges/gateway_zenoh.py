"""A gateway in a Zenoh network: puts frames under keys, hears what is put under KEY/inbound, answers late joiners.

Zenoh may wait in each call and calls from threads of its own: all of it is done in threads beside the loop.
Knows no packet or document.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from contextlib import suppress

import zenoh

from router.edges.daemon_thread import DaemonThread
from router.edges.gateway_binding import RETRY_SECONDS
from router.edges.gateway_transport import HIGH_WATER, LOW_WATER, Client, Ears, Frame
from router.edges.gateway_zenoh_config import session_config, short, why_in_vain
from router.edges.gateway_zenoh_inbox import Inbox, Queries
from router.edges.gateway_zenoh_puts import Lost, Putter, key_of
from router.edges.log import logger
from router.errors import StartError
from router.table.model import Address, ZenohSettings

MOST = 16 << 20
"""Bytes that are received as one, unless said otherwise."""

CLOSING_SECONDS = 2.0
"""How long a session has to end."""


class ZenohTransport:
    """Its one client is the network, from when the session is open. `most` bounds in bytes what is received as one.

    Where the table names locators, they are all that is connected; only without any, others are looked for by
    multicast.
    """

    def __init__(self, settings: ZenohSettings, ears: Ears, most: int = MOST) -> None:
        self.address: Address | None = None
        self.is_ready = False
        self._settings = settings
        self._ears = ears
        self._most = most
        self._key = settings.key.value
        self._session: zenoh.Session | None = None
        self._client: ZenohClient | None = None
        self._session_thread = DaemonThread("zenoh session")
        self._answering = DaemonThread("zenoh answers")
        self._is_closed = False
        self._retrying: asyncio.Task[None] | None = None

    async def open(self) -> None:
        config = session_config(self._settings)
        self._loop = asyncio.get_running_loop()
        self._inbox = Inbox(self._ears, self._most)
        self._queries = Queries(self._answer)
        try:
            await self._connect(config)
        except zenoh.ZError as error:
            if why := why_in_vain(self._settings, str(error)):
                await self.close()
                raise StartError(why) from error
            logger.warning("Zenoh cannot be reached yet: trying each second", key=self._key, why=short(error))
            self._retrying = self._loop.create_task(self._retry(config))

    async def close(self) -> None:
        self._is_closed = True
        self.is_ready = False
        if self._retrying is not None:
            self._retrying.cancel()
            with suppress(asyncio.CancelledError):
                await self._retrying
        if self._client is not None:
            self._inbox.stop()
            self._client.close()
        if self._session is not None:
            closing = self._loop.run_in_executor(self._session_thread, self._session.close)
            await asyncio.wait([closing], timeout=CLOSING_SECONDS)
        for thread in (self._session_thread, self._answering):
            thread.shutdown()
        self._client = self._session = None

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        for client in clients:
            client.write(frames)

    async def _connect(self, config: zenoh.Config) -> None:
        """Raises ZError."""
        session = await self._loop.run_in_executor(self._session_thread, self._open_session, config)
        if session is None:
            return
        self._session = session
        self._client = ZenohClient(self._key, Putter(session, self._key), self._ears)
        self.is_ready = True
        self._ears.joined(self._client)
        self._inbox.start(self._client)

    def _open_session(self, config: zenoh.Config) -> zenoh.Session | None:
        """In its thread. Raises ZError. None when nobody wants it any more."""
        session = zenoh.open(config)
        if self._is_closed:
            session.close()  # type: ignore[no-untyped-call]  # as Zenoh's stubs have it
            return None
        session.declare_subscriber(f"{self._key}/inbound/**", self._inbox.hear)
        session.declare_queryable(f"{self._key}/**", self._queries.hear)
        return session

    async def _retry(self, config: zenoh.Config) -> None:
        while not self.is_ready:
            await asyncio.sleep(RETRY_SECONDS)
            try:
                await self._connect(config)
            except zenoh.ZError as error:
                logger.debug("Zenoh cannot be reached yet", key=self._key, why=short(error))
            else:
                logger.info("Zenoh is reached", key=self._key)

    def _answer(self) -> None:
        """What is asked for at the same time is looked up once."""
        if self._is_closed:
            return
        queries, frames = self._queries.take(), self._ears.snapshot()
        answering = self._loop.run_in_executor(self._answering, _reply, queries, self._key, frames)
        answering.add_done_callback(self._answered)

    def _answered(self, answering: asyncio.Future[zenoh.ZError | None]) -> None:
        if not answering.cancelled() and (error := answering.result()) is not None:
            self._ears.failed(None, error, 0)


class ZenohClient:
    """Everybody in the network. Its backlog is of small frames; of large ones the newest of each key waits apart."""

    def __init__(self, key: str, putter: Putter, ears: Ears) -> None:
        self.label = f"zenoh {key}"
        self._putter = putter
        self._ears = ears
        self._loop = asyncio.get_running_loop()
        self._waiting: list[Frame] = []
        self._backlog = 0
        self._was_high = False
        self._is_putting = False
        self._is_open = True

    def write(self, frames: Sequence[Frame]) -> None:
        if not self._is_open:
            return
        self._waiting.extend(frames)
        self._backlog += sum(len(frame.data) for frame in frames)
        self._was_high = self._was_high or self._backlog >= HIGH_WATER
        if not self._is_putting:
            self._put()

    def backlog(self) -> int:
        return self._backlog

    def close(self) -> None:
        if self._is_open:
            self._is_open = False
            self._putter.close()
            self._ears.left(self)

    def _put(self) -> None:
        """All that waits, in one go; what is written meanwhile goes in the next."""
        frames, self._waiting = self._waiting, []
        size = sum(len(frame.data) for frame in frames)
        self._is_putting = True
        putting = asyncio.wrap_future(self._putter.put(frames))
        putting.add_done_callback(lambda done: self._has_put(done, size))

    def _has_put(self, putting: asyncio.Future[list[Lost]], size: int) -> None:
        self._is_putting = False
        self._backlog -= size
        if not self._is_open:
            return
        for error, lost in putting.result():
            self._ears.failed(self, error, lost)
        if self._waiting:
            self._put()
        if self._was_high and self._backlog < LOW_WATER:
            self._was_high = False
            self._ears.drained(self)


def _reply(queries: Sequence[zenoh.Query], root: str, frames: Sequence[Frame]) -> zenoh.ZError | None:
    """In its thread. Returns the last error: whoever asked has gone, mostly."""
    failure = None
    for query in queries:
        with query:
            for frame in frames:
                key = key_of(root, frame)
                try:
                    if query.key_expr.intersects(key):
                        query.reply(key, frame.data)
                except zenoh.ZError as error:
                    failure = error
    return failure
