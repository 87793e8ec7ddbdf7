"""A gateway in a Zenoh network: puts frames under keys, hears what is put under KEY/inbound, answers late joiners.

Zenoh may wait in each call and calls from threads of its own: all of it is done in threads beside the loop.
Knows no packet or document.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Protocol

import zenoh

from router.errors import StartError
from router.gateway.transport.base import HIGH_WATER, LOW_WATER, Client, Ears, Frame
from router.gateway.transport.binding import RETRY_SECONDS
from router.gateway.transport.zenoh_config import session_config, short, why_in_vain
from router.gateway.transport.zenoh_inbox import Inbox, Queries
from router.gateway.transport.zenoh_owner import Owner, all_tokens, owner_of, owners, this_owner
from router.gateway.transport.zenoh_puts import Lost, Putter, key_of
from router.log import logger
from router.table.model import Address, ZenohSettings
from router.threads.daemon_thread import DaemonThread

MOST = 16 << 20
"""Bytes that are received as one, unless said otherwise."""

CLOSING_SECONDS = 2.0
"""How long a session has to end."""

PAUSE_SECONDS = 0.2
"""Between two times that it begins or gives up, however often others come and go."""

LOOK_AGAIN_SECONDS = 2.0
"""While it waits for the key: in case that it was not heard how the last other one went."""

MOST_OTHERS = 100
"""Others of its key that a gateway remembers."""


class _Declared(Protocol):
    def undeclare(self) -> None: ...


class ZenohTransport:
    """Its one client is the network, from when the session is open and the key is free. `most` bounds in bytes what
    is received as one.

    Where the table names locators, they are all that is connected; only without any, others are looked for by
    multicast.
    """

    def __init__(self, settings: ZenohSettings, ears: Ears, most: int = MOST) -> None:
        self.address: Address | None = None
        self._settings = settings
        self._ears = ears
        self._most = most
        self._key = settings.key.value
        self._session: zenoh.Session | None = None
        self._client: ZenohClient | None = None
        self._owner: Owner | None = None
        self._others: set[Owner] = set()
        self._met: set[Owner] = set()
        self._told: set[Owner] = set()
        self._others_changed = asyncio.Event()
        self._declared: list[_Declared] = []
        self._session_thread = DaemonThread("zenoh session")
        self._answering = DaemonThread("zenoh answers")
        self._is_closed = False
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def is_ready(self) -> bool:
        return self._client is not None

    async def open(self) -> None:
        config = session_config(self._settings)
        self._loop = asyncio.get_running_loop()
        try:
            await self._connect(config)
        except zenoh.ZError as error:
            if why := why_in_vain(self._settings, str(error)):
                await self.close()
                raise StartError(why) from None  # the library's error may quote passwords
            logger.warning("Zenoh cannot be reached yet: trying each second", key=self._key, why=short(error))
            self._tasks.append(self._loop.create_task(self._retry(config)))

    async def close(self) -> None:
        self._is_closed = True
        for task in self._tasks:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        if self._client is not None:
            self._inbox.stop()
            self._client.close()
        self._client = None
        if self._session is not None:
            closing = self._loop.run_in_executor(self._session_thread, self._session.close)
            await asyncio.wait([closing], timeout=CLOSING_SECONDS)
        for thread in (self._session_thread, self._answering):
            thread.shutdown()
        self._session = None

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        for client in clients:
            client.write(frames)

    # -- the session ---------------------------------------------------------------------------------------------

    async def _connect(self, config: zenoh.Config) -> None:
        """Raises ZError."""
        self._session = await self._loop.run_in_executor(self._session_thread, self._open_session, config)
        if self._session is not None:
            self._tasks.append(self._loop.create_task(self._mind(self._session)))

    def _open_session(self, config: zenoh.Config) -> zenoh.Session | None:
        """In its thread. Raises ZError. None when nobody wants it any more."""
        session = zenoh.open(config)
        if self._is_closed:
            session.close()  # type: ignore[no-untyped-call]  # as Zenoh's stubs have it
            return None
        return session

    async def _retry(self, config: zenoh.Config) -> None:
        while self._session is None:
            await asyncio.sleep(RETRY_SECONDS)
            try:
                await self._connect(config)
            except zenoh.ZError as error:
                logger.debug("Zenoh cannot be reached yet", key=self._key, why=short(error))
            else:
                logger.info("Zenoh is reached", key=self._key)

    # -- who has the key -----------------------------------------------------------------------------------------

    def _heard_of(self, owner: Owner, is_there: bool) -> None:
        if not is_there:
            self._others.discard(owner)
        elif len(self._others | self._met) < MOST_OTHERS:
            self._meet({owner})
        self._others_changed.set()

    def _meet(self, others: set[Owner]) -> None:
        self._others |= others
        self._met |= others

    async def _mind(self, session: zenoh.Session) -> None:
        """Asks who has the key, and has `_settle` follow what is heard. While it waits for the key, it asks again."""
        look = self._watch
        while True:
            try:
                if self._client is None and not self._others_changed.is_set():
                    others = await self._loop.run_in_executor(self._session_thread, look, session)
                    look = self._look
                    if others is not None:
                        self._others.clear()
                        self._meet(others)
                self._others_changed.clear()
                await self._settle(session)
            except zenoh.ZError as error:
                self._ears.failed(None, error, 0)
            await asyncio.sleep(PAUSE_SECONDS)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._others_changed.wait(), None if self._client else LOOK_AGAIN_SECONDS)

    def _watch(self, session: zenoh.Session) -> set[Owner] | None:
        """In the session's thread: looks, and has `_heard_of` told of what changes afterwards. Raises ZError."""
        own = str(session.zid())

        def hear(sample: zenoh.Sample) -> None:
            owner = owner_of(sample.key_expr)
            if owner is not None and owner.session != own:
                is_there = sample.kind == zenoh.SampleKind.PUT
                self._loop.call_soon_threadsafe(self._heard_of, owner, is_there)

        others = self._look(session)  # first: beside a subscriber Zenoh answers from what that has heard until then
        session.liveliness().declare_subscriber(all_tokens(self._key), hear, history=True)
        return others

    def _look(self, session: zenoh.Session) -> set[Owner] | None:
        """In the session's thread. Raises ZError."""
        return owners(session, self._key)

    async def _settle(self, session: zenoh.Session) -> None:
        """Takes the key when nobody has it, gives it up to one that had it before, tells of others. Raises ZError."""
        first = min(self._others, default=None)
        if self._owner is None and first is None:
            first = await self._take(session)
        has_to_wait = first is not None and (self._owner is None or first < self._owner)
        if self._owner is not None and has_to_wait:
            await self._give_up()
        if untold := self._met - self._told:
            what = "this gateway waits until it is free" if has_to_wait else "that came later, and has to give way"
            logger.error(f"another gateway has the Zenoh key: {what}", key=self._key, other=str(min(untold)))
            self._ears.contended()
        elif self._told and not self._others:
            logger.info("no other gateway has the Zenoh key any more", key=self._key)
        self._told = set(self._others)
        self._met.clear()

    async def _take(self, session: zenoh.Session) -> Owner | None:
        """Takes the key, and serves unless another took it in the same moment and was first. Raises ZError."""
        self._inbox = Inbox(self._ears, self._most)
        self._queries = Queries(self._answer)
        owner = this_owner(session)
        others = await self._loop.run_in_executor(self._session_thread, self._declare, session, owner)
        self._owner = owner
        self._meet(others)
        first = min(self._others, default=owner)
        if first < owner:
            return first
        self._client = ZenohClient(self._key, Putter(session, self._key), self._ears)
        self._ears.joined(self._client)
        self._inbox.start(self._client)
        return min(self._others, default=None)

    def _declare(self, session: zenoh.Session, owner: Owner) -> set[Owner]:
        """In the session's thread: returns who else has the key. Raises ZError."""
        self._declared = [
            session.liveliness().declare_token(owner.token(self._key)),
            session.declare_subscriber(f"{self._key}/inbound/**", self._inbox.hear),
            session.declare_queryable(f"{self._key}/**", self._queries.hear),
        ]
        return owners(session, self._key) or set()

    async def _give_up(self) -> None:
        """Serves nobody any more. What waits is lost: it may be old when the key is free."""
        self._owner = None
        if self._client is not None:
            self._inbox.stop()
            self._client.close()
            self._client = None
        await self._loop.run_in_executor(self._session_thread, self._release)

    def _release(self) -> None:
        """In the session's thread. Raises ZError."""
        while self._declared:
            self._declared.pop().undeclare()  # the token last

    def _answer(self) -> None:
        """What is asked for at the same time is looked up once."""
        if self._client is None:
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
