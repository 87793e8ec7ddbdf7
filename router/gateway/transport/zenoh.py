"""A gateway in a Zenoh network: puts frames under keys, receives samples under KEY/inbound, answers queries.

Any call of Zenoh may block, and its callbacks run in its own threads, so no call is made in the loop's thread.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from typing import Union

import zenoh

from router.errors import TransportError
from router.gateway.transport.arrival import LoopClock
from router.gateway.transport.base import LOW_WATER, PER_TURN, Client, Events, Frame, report_fault
from router.gateway.transport.binding import RETRY_SECONDS
from router.gateway.transport.zenoh_session import (
    Owner,
    all_tokens,
    connections,
    owner_of,
    owners,
    permanent,
    session_config,
    short,
    this_owner,
)
from router.log import logger
from router.table.model.gateways import ZenohSettings
from router.threads import DaemonThread

CLOSING_SECONDS = 2.0
"""Timeout for closing a session."""

PAUSE_SECONDS = 0.2
"""The minimum time between two changes of the key's owner, even if others come and go more often."""

LOOK_AGAIN_SECONDS = 2.0
"""The interval of checks for the owner while waiting for the key, in case a message was lost."""

CONNECTIONS_SECONDS = 1.0
"""The interval of checks of connections."""

MOST_OTHERS = 100
"""Maximum other owners of its key that a gateway remembers."""

MOST_RECEIVED = 1000
MOST_RECEIVED_BYTES = 64 << 20
"""Maximum samples, and their bytes, in the queue to the loop; others are rejected."""

MOST_QUERIES = 100
"""Maximum pending queries; each answer may be large."""

LARGE = 64 * 1024
"""Bytes above which a put can take long."""

Declared = Union[zenoh.LivelinessToken, "zenoh.Subscriber[None]", "zenoh.Queryable[None]"]


class ZenohTransport:
    """Zenoh. The whole network is one client, which joins once the session is open and the key is free.

    `most` limits the bytes of a received sample. If the table names locators, only they are used; otherwise others are
    found by multicast.
    """

    def __init__(self, settings: ZenohSettings, events: Events, most: int) -> None:
        self._settings = settings
        self._events = events
        self._most = most
        self._key = settings.key.value
        self._session: zenoh.Session | None = None
        self._client: ZenohClient | None = None
        self._owner: Owner | None = None  # this gateway, while it owns the key
        self._others: set[Owner] = set()
        self._seen: set[Owner] = set()  # since they were last reported
        self._reported: set[Owner] = set()
        self._others_changed = asyncio.Event()
        self._declared: list[Declared] = []
        self._session_thread = DaemonThread("zenoh session")
        self._answering = DaemonThread("zenoh answers")
        self._is_closed = False
        self._tasks: list[asyncio.Task[None]] = []

    async def open(self) -> None:
        config = session_config(self._settings)
        self._loop = asyncio.get_running_loop()
        try:
            await self._connect(config)
        except zenoh.ZError as error:
            if refusal := permanent(self._settings, str(error)):
                await self.close()
                raise refusal from None  # the library's error may quote passwords
            logger.warning("Zenoh is not reachable yet; retrying every second", key=self._key, why=short(error))
            self._tasks.append(self._loop.create_task(self._retry(config)))

    async def close(self) -> None:
        self._is_closed = True
        for task in self._tasks:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        self._stop_serving()
        if self._session is not None:
            closing = self._loop.run_in_executor(self._session_thread, self._session.close)
            await asyncio.wait([closing], timeout=CLOSING_SECONDS)
            self._events.connected(0)
        for thread in (self._session_thread, self._answering):
            thread.shutdown()
        self._session = None

    def write_all(self, clients: Iterable[Client], frames: Sequence[Frame]) -> None:
        for client in clients:
            client.write(frames)

    # -- the session ---------------------------------------------------------------------------------------------

    async def _connect(self, config: zenoh.Config) -> None:
        """Open the session, and start the tasks that use it. Raises ZError."""
        self._session = await self._loop.run_in_executor(self._session_thread, self._open_session, config)
        if self._session is not None:
            for task in (self._manage_key, self._watch_connections):
                self._tasks.append(self._loop.create_task(task(self._session)))

    def _open_session(self, config: zenoh.Config) -> zenoh.Session | None:
        """Open a session, in its thread; return None if the transport was closed meanwhile. Raises ZError."""
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
                logger.debug("Zenoh is not reachable yet", key=self._key, why=short(error))
            else:
                logger.info("connected to Zenoh", key=self._key)

    async def _watch_connections(self, session: zenoh.Session) -> None:
        """Report each change of the number of connected routers and peers. Zenoh reconnects automatically."""
        reported, was_lost = None, False
        while True:
            connected = await self._loop.run_in_executor(self._session_thread, connections, session)
            if connected != reported:
                self._events.connected(connected)
                if not connected and reported:
                    was_lost = True
                    logger.warning("connection to the Zenoh network lost; Zenoh is reconnecting", key=self._key)
                elif connected and was_lost:
                    was_lost = False
                    logger.info("reconnected to the Zenoh network", key=self._key)
                reported = connected
            await asyncio.sleep(CONNECTIONS_SECONDS)

    # -- the owner of the key ------------------------------------------------------------------------------------

    def _on_token(self, owner: Owner, is_there: bool) -> None:
        if not is_there:
            self._others.discard(owner)
        elif len(self._others | self._seen) < MOST_OTHERS:
            self._add_owners({owner})
        self._others_changed.set()

    def _add_owners(self, others: set[Owner]) -> None:
        self._others |= others
        self._seen |= others

    async def _manage_key(self, session: zenoh.Session) -> None:
        """Find the owners, and decide at each change who owns the key; look again while waiting for it."""
        look: Callable[[zenoh.Session], set[Owner] | None] = self._watch
        while True:
            try:
                if self._client is None and not self._others_changed.is_set():
                    others = await self._loop.run_in_executor(self._session_thread, look, session)
                    look = partial(owners, key=self._key)
                    if others is not None:
                        self._others.clear()
                        self._add_owners(others)
                self._others_changed.clear()
                await self._decide_owner(session)
            except zenoh.ZError as error:
                self._events.failed(None, error, 0)
            await asyncio.sleep(PAUSE_SECONDS)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._others_changed.wait(), None if self._client else LOOK_AGAIN_SECONDS)

    def _watch(self, session: zenoh.Session) -> set[Owner] | None:
        """Find the owners and subscribe to changes. Runs in the session's thread. Raises ZError."""
        own = str(session.zid())

        def on_sample(sample: zenoh.Sample) -> None:
            owner = owner_of(sample.key_expr)
            if owner is not None and owner.session != own:
                is_there = sample.kind == zenoh.SampleKind.PUT
                self._loop.call_soon_threadsafe(self._on_token, owner, is_there)

        # Before subscribing: once there is a subscriber, Zenoh answers from the tokens that it has received.
        others = owners(session, self._key)
        session.liveliness().declare_subscriber(all_tokens(self._key), on_sample, history=True)
        return others

    async def _decide_owner(self, session: zenoh.Session) -> None:
        """Take the key if it is free, give it up to an earlier owner, report other owners. Raises ZError."""
        first = min(self._others, default=None)
        if self._owner is None and first is None:
            first = await self._take(session)
        has_to_wait = first is not None and (self._owner is None or first < self._owner)
        if self._owner is not None and has_to_wait:
            await self._give_up()
        if new := self._seen - self._reported:
            what = (
                "this gateway waits until the key is free"
                if has_to_wait
                else "the other one took it later and must give it up"
            )
            logger.error(f"another gateway uses the Zenoh key: {what}", key=self._key, other=str(min(new)))
            self._events.contended()
        elif self._reported and not self._others:
            logger.info("no other gateway uses the Zenoh key any more", key=self._key)
        self._reported = set(self._others)
        self._seen.clear()

    async def _take(self, session: zenoh.Session) -> Owner | None:
        """Take the key, and serve unless another gateway took it at the same time and was first.

        Returns the first of the other owners. Raises ZError.
        """
        self._inbox = Inbox(self._events, self._most)
        self._queries = Queries()
        owner = this_owner(session)
        others = await self._loop.run_in_executor(self._session_thread, self._declare, session, owner)
        self._owner = owner
        self._add_owners(others)
        first = min(self._others, default=owner)
        if first < owner:
            return first
        self._client = ZenohClient(self._key, Putter(session, self._key), self._events)
        self._events.joined(self._client)
        self._inbox.start(self._client)
        self._answering_queries = self._loop.create_task(self._answer_queries(self._queries))
        return min(self._others, default=None)

    def _declare(self, session: zenoh.Session, owner: Owner) -> set[Owner]:
        """Declare this owner, and return the others. Runs in the session's thread. Raises ZError."""
        self._declared = [
            session.liveliness().declare_token(owner.token(self._key)),
            session.declare_subscriber(f"{self._key}/inbound/**", self._inbox.on_sample),
            session.declare_queryable(f"{self._key}/**", self._queries.on_query),
        ]
        return owners(session, self._key) or set()

    async def _give_up(self) -> None:
        """Stop serving, and discard waiting data: it may be old when the key is free."""
        self._owner = None
        self._stop_serving()
        await self._loop.run_in_executor(self._session_thread, self._release)

    def _stop_serving(self) -> None:
        if self._client is not None:
            self._answering_queries.cancel()
            self._inbox.stop()
            self._client.close()
            self._client = None

    def _release(self) -> None:
        """Undeclare everything, the token last, in the session's thread. Raises ZError."""
        while self._declared:
            self._declared.pop().undeclare()  # type: ignore[no-untyped-call]  # as Zenoh's stubs have it; the token last

    # -- queries -------------------------------------------------------------------------------------------------

    async def _answer_queries(self, queries: Queries) -> None:
        """Answer queries from now on, all pending ones from one snapshot."""
        while True:
            await queries.arrived.wait()
            queries.arrived.clear()
            try:
                waiting = queries.take()
                frames = await self._events.snapshot()
                error = await self._loop.run_in_executor(self._answering, _reply, waiting, self._key, frames)
            except Exception as fault:  # noqa: BLE001 reported; the next query is still answered
                report_fault("left a query unanswered", fault)
            else:
                if error is not None:
                    self._events.failed(None, error, 0)


class Inbox:
    """The queue of samples from Zenoh's threads to the loop. `most` limits the bytes of one sample."""

    def __init__(self, events: Events, most: int) -> None:
        self._client: Client | None = None
        self._events = events
        self._most = most
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[bytes, int]] = deque()
        # Only one thread writes each counter.
        self._received_bytes = self._delivered_bytes = 0
        self._lost = self._reported_lost = 0
        self._clock = LoopClock()

    def start(self, client: Client) -> None:
        """Start to deliver samples, as if `client` sent them."""
        self._client = client
        self._clock.start()
        self._deliver()

    def stop(self) -> None:
        self._client = None
        self._clock.stop()

    def on_sample(self, sample: zenoh.Sample) -> None:
        """Queue a sample, or reject it if there is no room. Runs in Zenoh's thread."""
        if sample.kind != zenoh.SampleKind.PUT:  # not `is`: each is a new object
            return
        size = len(sample.payload)
        waiting_bytes = self._received_bytes - self._delivered_bytes
        if size > self._most:
            self._loop.call_soon_threadsafe(self._events.refused, "too_large")
        elif len(self._waiting) >= MOST_RECEIVED or waiting_bytes + size > MOST_RECEIVED_BYTES:
            self._lost += 1  # reported by `_deliver`
        else:
            self._received_bytes += size
            self._waiting.append((sample.payload.to_bytes(), self._clock.stamp()))
            if len(self._waiting) == 1:
                self._loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        if self._client is None:
            return
        try:
            for _ in range(min(len(self._waiting), PER_TURN)):
                data, arrived = self._waiting.popleft()
                self._delivered_bytes += len(data)
                self._events.received(self._client, data, arrived)
        finally:
            if self._waiting:  # otherwise `on_sample` schedules the next call
                self._loop.call_soon(self._deliver)
        for _ in range(self._lost - self._reported_lost):
            self._reported_lost += 1
            self._events.refused("rate_limited")


class Queries:
    """Pending queries. `arrived` is set when the first one is added."""

    def __init__(self) -> None:
        self.arrived = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[zenoh.Query] = deque()

    def on_query(self, query: zenoh.Query) -> None:
        """Queue a query, or reject it if too many are pending. Runs in Zenoh's thread."""
        if len(self._waiting) >= MOST_QUERIES:
            with query:
                query.reply_err("too many pending queries: try again")
            return
        self._waiting.append(query)
        if len(self._waiting) == 1:
            self._loop.call_soon_threadsafe(self.arrived.set)

    def take(self) -> list[zenoh.Query]:
        """Remove and return all pending queries."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]


class ZenohClient:
    """The network as a client. Its backlog has small frames; the newest large one of each key waits separately."""

    def __init__(self, key: str, putter: Putter, events: Events) -> None:
        self.label = f"zenoh {key}"
        self._putter = putter
        self._events = events
        self._waiting: list[Frame] = []
        self._backlog = 0
        self._is_putting = False
        self._is_open = True

    def write(self, frames: Sequence[Frame]) -> None:
        if not self._is_open:
            return
        self._waiting.extend(frames)
        self._backlog += sum(len(frame.data) for frame in frames)
        if not self._is_putting:
            self._put()

    def backlog(self) -> int:
        return self._backlog

    def close(self) -> None:
        if self._is_open:
            self._is_open = False
            self._putter.close()
            self._events.left(self)

    def _put(self) -> None:
        """Put all waiting frames at once; frames that are written meanwhile are put by the next call."""
        frames, self._waiting = self._waiting, []
        size = sum(len(frame.data) for frame in frames)
        self._is_putting = True
        putting = asyncio.wrap_future(self._putter.put(frames))
        putting.add_done_callback(lambda done: self._on_put(done, size))

    def _on_put(self, putting: asyncio.Future[list[Exception]], size: int) -> None:
        self._is_putting = False
        self._backlog -= size
        if not self._is_open:
            return
        for error in putting.result():
            self._events.failed(self, error, 1)
        if self._waiting:
            self._put()
        if self._backlog < LOW_WATER:
            self._events.drained(self)


class Putter:
    """Puts frames under KEY/data/TOPIC and KEY/schema/TYPE, in threads: a put may wait for a slow network.

    Large values have their own thread and a lower priority, and only the newest of each key waits there, so that small
    ones are not delayed. A key that once had a large value counts as large from then on.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._session = session
        self._key = key
        self._small = DaemonThread("zenoh puts")
        self._large = DaemonThread("zenoh large puts")
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._large_keys: set[str] = set()
        self._large_waiting: dict[str, bytes] = {}
        self._failed_large: list[Exception] = []
        self._lock = threading.Lock()

    def put(self, frames: Sequence[Frame]) -> Future[list[Exception]]:
        """Put small frames and queue large ones. The result is an error for each lost frame."""
        return self._small.submit(self._put_all, frames)

    def close(self) -> None:
        """Discard waiting frames; a put in progress is not interrupted."""
        for executor in (self._small, self._large):
            executor.shutdown()

    def _put_all(self, frames: Sequence[Frame]) -> list[Exception]:
        errors: list[Exception] = []
        for frame in frames:
            key = key_of(self._key, frame)
            if len(frame.data) > LARGE:
                self._large_keys.add(key)
            try:
                if key in self._large_keys:
                    self._queue_large(key, frame.data)
                else:
                    self._put(key, frame.data, is_large=False)
            except (zenoh.ZError, TransportError) as error:
                errors.append(error)
        with self._lock:
            failed, self._failed_large = self._failed_large, []
        return errors + failed

    def _queue_large(self, key: str, data: bytes) -> None:
        """Queue a value. Raises TransportError if it replaces another one."""
        with self._lock:
            is_newer = key in self._large_waiting
            self._large_waiting[key] = data
        if is_newer:
            raise TransportError("a large message was replaced by a newer one before it was sent")
        self._large.submit(self._put_large)

    def _put_large(self) -> None:
        with self._lock:
            key, data = next(iter(self._large_waiting.items()))
            del self._large_waiting[key]
        try:
            self._put(key, data, is_large=True)
        except Exception as error:  # noqa: BLE001 - reported with the next frames
            with self._lock:
                self._failed_large.append(error)

    def _put(self, key: str, data: bytes, *, is_large: bool) -> None:
        """Put a value under a key. Raises ZError."""
        publisher = self._publishers.get((key, is_large))
        if publisher is None:
            priority = zenoh.Priority.DATA_LOW if is_large else zenoh.Priority.DATA
            drop = zenoh.CongestionControl.DROP
            publisher = self._session.declare_publisher(key, congestion_control=drop, priority=priority)
            self._publishers[key, is_large] = publisher
        publisher.put(data)


def key_of(root: str, frame: Frame) -> str:
    """Return the key of a frame below the gateway's own key."""
    if frame.is_schema:
        return f"{root}/schema/{frame.type_name}"
    return f"{root}/data/{frame.topic.lstrip('/')}" if frame.type_name else f"{root}/{frame.topic}"


def _reply(queries: Sequence[zenoh.Query], root: str, frames: Sequence[Frame]) -> zenoh.ZError | None:
    """Answer queries; runs in a thread. Returns the last error: usually the querier has left."""
    failure = None
    for query in queries:
        with query:
            for frame in frames:
                key = key_of(root, frame) + (f"/{frame.older}" if frame.older else "")
                try:
                    if query.key_expr.intersects(key):
                        query.reply(key, frame.data)
                except zenoh.ZError as error:
                    failure = error
    return failure
