"""Deadmen of gateway clients publish in their own thread, and nobody waits for the middleware but this thread."""

from __future__ import annotations

import ctypes
import gc
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from struct import Struct
from time import sleep
from typing import Any, cast

import pytest

from router.carrier.client_deadmen import ClientDeadmen
from router.carrier.deadmen import NativeDeadman
from router.carrier.ring import Ring
from router.clock import boottime_ns
from router.compiler.compiled_table import DeadmanPlan
from router.compiler.metrics import Counters
from router.image.names import Names
from tests.carrier.building import MEMORY, RACES, run_program
from tests.carrier.opening import opened_deadman
from tests.carrier.publishing import Publisher, wait_until
from tests.carrier.serving_ros import middleware

MS = 1_000_000
NEVER_MS = 3_600_000
_EVENT = Struct("@IIIIiI")
_KINDS = {1: "tripped", 2: "released", 3: "error"}
_CALLED = "middleware_publish", "middleware_error", "middleware_forget_error"


@pytest.fixture(scope="session")
def functions(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return middleware(tmp_path_factory.mktemp("middleware") / "middleware.so")


class Clients:
    """The deadmen of topics, with publishers of a middleware for tests."""

    def __init__(self, library: ctypes.CDLL, functions: ctypes.CDLL) -> None:
        self._library = library
        self.publishers: dict[str, Publisher] = {}
        self.counts = (ctypes.c_int64 * 200)()
        self._counters, self._names, self._functions = Counters(), Names(), functions
        self._events = Ring(library, 1 << 14)
        self.deadmen = ClientDeadmen(library, self.counts, self._events, self._names)
        addresses = tuple(ctypes.cast(getattr(functions, name), ctypes.c_void_p).value or 0 for name in _CALLED)
        self.deadmen.start(cast("Any", addresses))

    def add(
        self, topic: str = "/word", timeout_ms: int = 10, repeat_ms: int = NEVER_MS, *, at_start: bool = True
    ) -> NativeDeadman:
        if topic not in self.publishers:
            self.publishers[topic] = Publisher(self._functions)
        payload = (topic, (b"stop " + topic.encode(),))
        plan = DeadmanPlan(f"gateway:{topic}", timeout_ms * MS, repeat_ms * MS, (payload,), at_start)
        return opened_deadman(
            self._library, self.deadmen.group, plan, self._counters, self._names, self.publishers, "publisher"
        )

    def count(self, metric: str, topic: str = "/word") -> int:
        labels = (topic,) if metric in {"datagrams_sent", "send_errors"} else ()
        return self.counts[self._counters.index(f"deadman_{metric}", f"gateway:{topic}", *labels)]

    def events(self) -> list[tuple[str, str, str]]:
        """What happened to the deadman of which topic since the last call, and what the middleware said."""
        records, found, at = bytes(self._events.take()), [], 0
        while at < len(records):
            size, kind, route, *_ = _EVENT.unpack_from(records, at)
            text = records[at + _EVENT.size : at + size].partition(b"\0")[0].decode()
            found.append((_KINDS[kind], self._names.name(route).removeprefix("gateway:"), text))
            at += size
        return found

    def close(self) -> None:
        for publisher in self.publishers.values():
            publisher.impede()
        self.deadmen.stop()


@pytest.fixture
def clients(library: ctypes.CDLL, functions: ctypes.CDLL) -> Iterator[Clients]:
    opened = Clients(library, functions)
    yield opened
    opened.close()


def at_once(call: Callable[[], object]) -> None:
    """Fails if the call waits for something."""
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(20)
    assert not thread.is_alive()


def get_stuck(clients: Clients, topic: str = "/word") -> NativeDeadman:
    """Have the thread publish on a topic, and not come back."""
    deadman = clients.add(topic)
    clients.publishers[topic].impede(is_stuck=True)
    deadman.feed(boottime_ns())
    wait_until(lambda: clients.publishers[topic].is_called)
    return deadman


def test_in_a_silence_it_publishes_and_repeats_that_until_a_client_publishes(clients: Clients) -> None:
    deadman = clients.add(timeout_ms=5, repeat_ms=5)
    deadman.feed(boottime_ns())
    wait_until(lambda: clients.count("datagrams_sent") >= 3)
    assert clients.events() == [("tripped", "/word", "")]
    assert (clients.count("active"), clients.count("trips")) == (1, 1)
    deadman.feed(boottime_ns() + NEVER_MS * MS)
    assert clients.events() == [("released", "/word", "")]
    assert clients.deadmen.stop()
    published = clients.publishers["/word"].published()
    assert published == [b"stop /word"] * clients.count("datagrams_sent")
    assert (clients.count("active"), clients.count("trips"), clients.count("send_errors")) == (0, 1, 0)


def test_nobody_waits_for_a_publisher_that_is_stuck(clients: Clients) -> None:
    stuck, other = get_stuck(clients), clients.add("/other")
    for call in (
        lambda: stuck.feed(boottime_ns() + NEVER_MS * MS),
        lambda: other.feed(boottime_ns()),
        lambda: other.await_subscribers(boottime_ns()),
        lambda: other.greet(boottime_ns()),
        lambda: clients.deadmen.adopt({"a": stuck, "b": other}, {"a": clients.add(), "b": other}, 7),
    ):
        at_once(call)
    assert clients.events() == [("tripped", "/word", ""), ("released", "/word", "")]
    assert clients.deadmen.stalled() is not None
    clients.publishers["/word"].impede()
    wait_until(lambda: clients.deadmen.wait_for(7, 1))
    assert clients.deadmen.stalled() is None


def test_what_is_due_behind_a_stuck_publisher_is_published_unless_a_client_has_published_meanwhile(
    clients: Clients,
) -> None:
    stuck = get_stuck(clients)
    silent, fed = clients.add("/silent", timeout_ms=1), clients.add("/fed", timeout_ms=1)
    for each in (silent, fed):
        each.feed(boottime_ns())
    sleep(0.01)
    fed.feed(boottime_ns() + NEVER_MS * MS)
    clients.publishers["/word"].impede()
    wait_until(lambda: clients.count("datagrams_sent", "/silent"))
    assert clients.count("trips", "/fed") == clients.publishers["/fed"].count == 0
    assert clients.count("active") == 1
    del stuck


def test_slow_publishers_have_turns(clients: Clients) -> None:
    topics = ["/one", "/two", "/three"]
    deadmen = [clients.add(topic, timeout_ms=1, repeat_ms=1) for topic in topics]
    for topic, deadman in zip(topics, deadmen, strict=True):
        clients.publishers[topic].impede(delay_us=3000)
        deadman.feed(boottime_ns())
    wait_until(lambda: all(clients.count("datagrams_sent", topic) >= 3 for topic in topics))


def test_what_the_middleware_refuses_is_counted_and_reported_with_its_words(clients: Clients) -> None:
    deadman = clients.add()
    clients.publishers["/word"].impede(refusal="no room " + "x" * 400)
    deadman.feed(boottime_ns())
    wait_until(lambda: clients.count("send_errors"))
    clients.deadmen.stop()
    [tripped, (what, topic, why), *_] = clients.events()
    assert (tripped, what, topic) == (("tripped", "/word", ""), "error", "/word")
    assert why == ("no room " + "x" * 400)[:255]
    assert clients.count("datagrams_sent") == 0


def test_a_subscriber_that_is_met_shortly_after_the_start_is_published_to_twice(clients: Clients) -> None:
    deadman, silent = clients.add(), clients.add("/silent", at_start=False)
    assert not deadman.greet(boottime_ns())  # nobody waits for subscribers
    for each in (deadman, silent):
        each.await_subscribers(boottime_ns())
    assert deadman.greet(boottime_ns())
    assert not silent.greet(boottime_ns())
    wait_until(lambda: clients.count("datagrams_sent") == 2)
    deadman.feed(boottime_ns() + NEVER_MS * MS)
    assert not deadman.greet(boottime_ns())
    assert clients.events() == []
    assert clients.count("trips") == clients.count("datagrams_sent", "/silent") == 0


def test_what_could_not_be_published_at_the_start_is_published_again(clients: Clients) -> None:
    deadman = clients.add()
    deadman.await_subscribers(boottime_ns())
    clients.publishers["/word"].impede(refusal="not yet")
    assert deadman.greet(boottime_ns())
    wait_until(lambda: clients.count("send_errors") == 2)  # at once, and half a second later
    clients.publishers["/word"].impede()
    wait_until(lambda: clients.count("datagrams_sent") == 1)
    clients.deadmen.stop()
    assert (clients.count("datagrams_sent"), clients.count("trips")) == (1, 0)


def test_at_a_reload_the_next_one_goes_on_and_one_that_has_none_publishes_a_last_time(clients: Clients) -> None:
    armed, leaving, idle = clients.add(timeout_ms=NEVER_MS), clients.add("/leaving", NEVER_MS), clients.add("/idle")
    for each in (armed, leaving):
        each.feed(boottime_ns())
    next_one = clients.add(timeout_ms=1)
    clients.deadmen.adopt({"a": armed, "b": leaving, "c": idle}, {"a": next_one}, 1)
    assert clients.deadmen.wait_for(1, 20)
    assert clients.count("datagrams_sent", "/leaving") == 1
    wait_until(lambda: clients.count("trips") == 1)
    armed.feed(boottime_ns() + NEVER_MS * MS)  # as a client's message that was on its way
    wait_until(lambda: clients.count("active") == 0)
    assert clients.publishers["/idle"].count == 0


def test_a_reload_is_not_over_before_a_stuck_publisher_and_what_follows_are(clients: Clients) -> None:
    stuck = get_stuck(clients)
    clients.deadmen.adopt({"a": stuck}, {}, 3)
    assert not clients.deadmen.wait_for(3, 0.05)
    clients.publishers["/word"].impede()
    assert clients.deadmen.wait_for(3, 20)
    assert clients.publishers["/word"].count == 2  # as it tripped, and at its end


def test_a_deadman_may_go_while_its_publisher_is_stuck(clients: Clients) -> None:
    stuck = get_stuck(clients)
    clients.publishers["/word"].impede(is_stuck=True, refusal="too late")
    del stuck
    gc.collect()
    clients.publishers["/word"].impede(refusal="too late")
    wait_until(lambda: clients.count("send_errors") == 1)


def test_at_the_stop_those_that_are_armed_publish_a_last_time(clients: Clients) -> None:
    kept = [clients.add("/idle"), clients.add("/armed", NEVER_MS), clients.add("/tripped", 1)]
    for each in kept[1:]:
        each.feed(boottime_ns())
    wait_until(lambda: clients.count("active", "/tripped"))
    before = clients.publishers["/tripped"].count
    assert clients.deadmen.stop()
    assert clients.deadmen.stop()
    counts = {topic: each.count for topic, each in clients.publishers.items()}
    assert counts == {"/idle": 0, "/armed": 1, "/tripped": before + 1}


def test_a_stop_leaves_a_stuck_publisher_behind_and_feeding_goes_on(clients: Clients) -> None:
    stuck = get_stuck(clients)
    assert not clients.deadmen.stop()
    assert not clients.deadmen.stop()
    clients.publishers["/word"].impede()
    stuck.feed(boottime_ns())
    wait_until(lambda: clients.publishers["/word"].count == 1)
    assert clients.count("datagrams_sent") == 0


def test_without_a_client_deadman_there_is_no_thread_to_wait_for(library: ctypes.CDLL) -> None:
    deadmen = ClientDeadmen(library, (ctypes.c_int64 * 10)(), Ring(library, 1 << 12), Names())
    deadmen.adopt({}, {}, 1)
    assert deadmen.wait_for(1, 0.01)
    assert deadmen.stop()


@pytest.mark.slow
@pytest.mark.parametrize("sanitizers", ["", RACES, MEMORY])
def test_clients_reloads_and_the_stop_at_once(tmp_path: Path, sanitizers: str) -> None:
    run_program("client_deadmen", tmp_path, 300, sanitizers=sanitizers)
