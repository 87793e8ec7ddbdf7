"""Topics that a whole router publishes on natively, and what it does where rcl is not as expected."""

from __future__ import annotations

import ctypes
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import closing

import pytest
from structlog.testing import capture_logs

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.app import Router
from router.errors import StartError
from tests.app.conftest import Site, numbered
from tests.ports import free_port
from tests.ros.peers import Subscriber, wait_until
from tests.tasks import thread_names

FLOAT = "std_msgs/msg/Float32"
ROUTES = f"""\
  ph_info:
    source: any
    topics: [{{topic: published_ph, type: {FLOAT}, fields: {{data: ph_value}}}}]
"""


@pytest.fixture
def subscriber() -> Iterator[Subscriber]:
    with closing(Subscriber("published_ph", FLOAT)) as made:
        yield made


def await_subscriber(router: Router, subscriber: Subscriber) -> None:
    """Both sides know each other."""
    ros = router._runtime.topics.node
    assert ros is not None
    assert subscriber.line() == "matched"
    wait_until(lambda: ros.demands["published_ph"].wanted)


def number(line: str) -> float:
    (found,) = struct.unpack("<xxxxf", bytes.fromhex(line))
    return float(found)


def test_a_message_is_published_while_python_is_held(site: Site, subscriber: Subscriber) -> None:
    python = ctypes.PyDLL(None)  # calls through PyDLL keep the interpreter lock
    datagram, line = numbered(7), ctypes.create_string_buffer(100)
    with site.router(ROUTES) as router:
        assert "publish" in thread_names()
        await_subscriber(router, subscriber)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("127.0.0.1", site.listen))
            python.send(sender.fileno(), datagram, len(datagram), 0)
            size = python.read(subscriber.process.stdout.fileno(), line, len(line))
        assert number(line.raw[:size].decode()) == 7.0
        wait_until(lambda: router.total("messages_published") == 1)
        assert router.total("messages_waiting") == 0


KEPT = ROUTES.replace("published_ph,", "published_kept, qos: {durability: transient_local},")


def test_topics_of_a_reload_are_wanted_while_the_thread_is_stuck(
    site: Site, subscriber: Subscriber, stuck: tuple[threading.Event, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    is_in, goes_on = stuck
    monkeypatch.setattr("router.app.plane._PATIENCE_S", 0.05)
    later = f"{{topic: published_ph, type: {FLOAT}, fields: {{data: ph_value}}}}"
    with site.router(KEPT) as router, capture_logs() as logs:
        site.send(numbered(1))
        assert is_in.wait(20)
        site.write(KEPT.replace("}}]", f"}}}}, {later}]"))
        assert router.reload().ok
        await_subscriber(router, subscriber)
        goes_on.set()
    assert [line["threads"] for line in logs if "its sockets and topics stay open" in line["event"]] == [["publish"]]


def test_a_reload_opens_again_what_a_stuck_thread_kept_open(
    site: Site, stuck: tuple[threading.Event, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    is_in, goes_on = stuck
    with site.router(KEPT) as router:
        site.send(numbered(1))
        assert is_in.wait(20)
        site.write(ROUTES, listen=f'  rover: {{address: "127.0.0.1:{free_port()}"}}')
        with monkeypatch.context() as impatient:  # the next reload waits for threads that have yet to run
            impatient.setattr("router.app.plane._PATIENCE_S", 0.05)
            assert router.reload().ok
        goes_on.set()
        wait_until(lambda: router.total("messages_published") == 1)
        site.write(KEPT.replace("Float32", "Float64"))
        result = router.reload()
        assert result.ok, result.text


def test_rcl_that_is_not_as_expected_ends_the_start(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("router.ros.rcl.publish_functions", lambda: None)
    with pytest.raises(StartError, match="the struct layout of rcl differs"), site.router(ROUTES):
        pass
    monkeypatch.undo()
    with site.router(ROUTES):  # nothing was left open
        pass
