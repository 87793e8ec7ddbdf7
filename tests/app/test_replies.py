"""Replies of a whole router: they go to the port that asked, from the listener that was asked, and each is counted."""

from __future__ import annotations

import socket
from contextlib import closing
from pathlib import Path

import pytest
from structlog.testing import capture_logs

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.app import Router
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.recording.mirror import Action
from tests.app.conftest import Site, udp
from tests.app.test_actions import watched
from tests.ports import free_port
from tests.repeating import repeating
from tests.ros.peers import wait_until

ASK, ANSWER = bytes.fromhex("9a010408011802"), bytes.fromhex("a2010a0d0000803f1500000040")
LONGER, LONGER_ANSWER = bytes.fromhex("9a010408011803"), bytes.fromhex("a2010a0d000000401500000040")


def table(max_rate: str = "1000000 Hz") -> str:
    return f"""\
  rock_measure_request:
    source: basestation
    reply: {{case: rock_measure_result, fields: {{length_cm: float32(x2 - x1), width_cm: 2}}, max_rate: {max_rate}}}
"""


def program(path: Path) -> CompiledTable:
    made = check_table(path).program
    assert made is not None
    return made


def test_a_reply_goes_to_the_port_that_asked_from_the_listener_that_was_asked(site: Site) -> None:
    other = free_port()
    listen = f'  rover: {{address: "127.0.0.1:{site.listen}"}}\n  radio: {{address: "127.0.0.1:{other}"}}'
    with Router(program(site.write(table(), listen=listen))) as router, udp("127.0.0.1") as second:
        for asking in (site.basestation, second):
            for port in (site.listen, other):
                asking.sendto(ASK, ("127.0.0.1", port))
                assert asking.recvfrom(1000) == (ANSWER, ("127.0.0.1", port))
        wait_until(lambda: router.total("datagrams_sent") == 4)


def test_a_reply_is_an_action(site: Site) -> None:
    with site.router(table()) as router:
        seen = watched(router)
        site.basestation.sendto(ASK, ("127.0.0.1", site.listen))
        wait_until(lambda: len(seen) >= 1)
    assert seen == [Action(0, "sent", "rock_measure_request", "basestation", data=ANSWER)]


def test_a_reply_that_nobody_takes_is_lost_and_said(site: Site) -> None:
    """The error is that of an earlier reply to that port, as for every datagram; each reply counts once."""
    port = free_port()
    with capture_logs() as logs, site.router(table()) as router:

        def is_lost() -> bool:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as leaving:
                leaving.bind(("127.0.0.1", port))
                leaving.sendto(ASK, ("127.0.0.1", site.listen))
            return router.total("messages_dropped") > 0

        def is_balanced() -> bool:
            sent, lost = router.total("datagrams_sent"), router.total("messages_dropped")
            return sent + lost == router.total("messages_received")

        wait_until(is_lost)
        wait_until(is_balanced)
    lost = [log for log in logs if log.get("reason") == "send_error"]
    assert lost
    assert lost[0]["target"] == "basestation"


def test_a_reload_keeps_the_limit_of_replies_and_adopts_other_ones(site: Site) -> None:
    def ask() -> None:
        site.basestation.sendto(ASK, ("127.0.0.1", site.listen))

    with site.router(table("0.01 Hz")) as router:
        ask()
        assert site.basestation.recv(1000) == ANSWER
        assert router.reload().ok
        ask()
        wait_until(lambda: router.total("messages_dropped") == 1)
        site.write(table().replace("width_cm: 2", "width_cm: 3"))
        assert router.reload().ok
        ask()
        assert site.basestation.recv(1000) == ANSWER[:-2] + bytes.fromhex("4040")


def test_replies_go_on_while_tables_are_exchanged(site: Site) -> None:
    """Each is what one of the tables says, and goes to the port that asked."""
    seen: list[set[bytes]] = [set(), set()]
    with closing(udp("127.0.0.1")) as first, closing(udp("127.0.0.1")) as second, site.router(table()) as router:

        def ask() -> None:
            for asking, request in ((first, ASK), (second, LONGER)):
                asking.sendto(request, ("127.0.0.1", site.listen))
            for asking, answers in zip((first, second), seen, strict=True):
                answers.add(asking.recv(1000))

        with repeating(ask, 0):
            for width in (3, 2, 3, 2):
                site.write(table().replace("width_cm: 2", f"width_cm: {width}"))
                assert router.reload().ok
                before = router.total("datagrams_sent")
                wait_until(lambda before=before: router.total("datagrams_sent") > before + 20)  # type: ignore[misc]
    wide = bytes.fromhex("4040")
    assert seen == [{ANSWER, ANSWER[:-2] + wide}, {LONGER_ANSWER, LONGER_ANSWER[:-2] + wide}]
