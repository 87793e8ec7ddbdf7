"""The transport that a gateway's settings ask for."""

from __future__ import annotations

from pathlib import Path

from router.gateway.transport.base import Events, Transport
from router.gateway.transport.stream import Limits
from router.gateway.transport.tcp import TcpTransport
from router.gateway.transport.udp import UdpTransport
from router.gateway.transport.websocket import WebsocketTransport
from router.table.model import Gateway, GatewayFormat
from router.table.model import Transport as Way

MOST_ASKED = 4096
"""Bytes of what a client may send that may publish nothing: it can only ask for schemas."""

PAGE = Path(__file__).with_name("page.html")


def new_transport(settings: Gateway, events: Events) -> Transport:
    """It is not open yet."""
    address = settings.address
    most = settings.max_message if settings.inbound else MOST_ASKED
    if settings.zenoh is not None:
        from router.gateway.transport.zenoh import ZenohTransport  # takes 50 ms to import

        return ZenohTransport(settings.zenoh, events, most)
    assert address is not None  # noqa: S101 - the schema wants one for all others
    if settings.transport.value is Way.UDP:
        return UdpTransport(address.value, settings.receive.value if settings.receive else None, events)
    limits = Limits(settings.max_clients, settings.max_clients_per_host, most)
    if settings.transport.value is Way.TCP:
        prefixed = settings.format is GatewayFormat.GATEWAY_V1
        return TcpTransport(address.value, events, limits, prefixed=prefixed)
    text = settings.format is GatewayFormat.JSON
    return WebsocketTransport(address.value, events, limits, text=text, page=PAGE.read_bytes())
