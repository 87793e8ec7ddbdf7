from __future__ import annotations

import socket

from router.table.addresses import Address
from router.tools.places import open_udp
from router.tools.sending import Sent, send

HERE = Address("127.0.0.1", 0)


def test_every_datagram_arrives_and_is_counted() -> None:
    with open_udp(HERE, "receiver") as receiver, open_udp(HERE, "sender") as sender:
        sent = Sent()
        send(sender, Address(*receiver.getsockname()), b"hello", 5, 1000, sent)
        assert [receiver.recv(100) for _ in range(5)] == [b"hello"] * 5
        assert (sent.count, sent.refused) == (5, 0)
        assert sent.seconds > 0


def test_a_port_where_nobody_listens_is_noticed_and_does_not_stop_the_sending() -> None:
    with open_udp(HERE, "gone") as gone:
        nobody = Address(*gone.getsockname())
    with open_udp(HERE, "sender") as sender:
        sent = Sent()
        send(sender, nobody, b"hello", 3, None, sent)
    assert (sent.count, sent.refused) == (3, 3)


def test_one_datagram_alone_has_no_rate() -> None:
    assert Sent(count=1, seconds=0.0).rate == 0
    assert Sent(count=11, seconds=2.0).rate == 5


def test_the_sender_keeps_the_address_it_was_opened_with() -> None:
    with open_udp(HERE, "receiver") as receiver, open_udp(Address("127.0.6.1", 0), "sender") as sender:
        receiver.settimeout(5)
        send(sender, Address(*receiver.getsockname()), b"x", 1, None, Sent())
        _, peer = receiver.recvfrom(10)
        assert peer[0] == "127.0.6.1"


def test_the_refusal_of_the_last_datagram_is_seen_too() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        nobody = Address(*gone.getsockname())
    sent = Sent()
    with open_udp(HERE, "sender") as sender:
        send(sender, nobody, b"hello", 1, None, sent)
    assert sent.refused == 1
