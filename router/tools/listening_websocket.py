"""A gateway's websocket: JSON documents as text, packets as binary messages."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from router.table.addresses import Address
from router.tools.listening_connected import CONNECT_TIMEOUT, ConnectedSource
from router.tools.listening_streams import LONGEST

_CLOSE_TIMEOUT = 1.0


class WebsocketSource(ConnectedSource):
    """A text message holds documents, one a line; a binary message is a packet."""

    def __init__(self, address: Address, say: Callable[[str], None]) -> None:
        super().__init__("websocket", address, say)

    def _open(self, opened: socket.socket, connected: ExitStack) -> None:
        try:
            self._websocket: ClientConnection = connected.enter_context(
                connect(
                    f"ws://{self._address}/",
                    sock=opened,
                    compression=None,
                    max_size=LONGEST,
                    open_timeout=CONNECT_TIMEOUT,
                    close_timeout=_CLOSE_TIMEOUT,
                )
            )
        except InvalidHandshake as error:
            raise OSError(f"it is no websocket: {error}") from error

    def _receive(self, timeout: float) -> Sequence[bytes]:
        try:
            message = self._websocket.recv(timeout)
        except TimeoutError:
            return ()
        except ConnectionClosed as error:
            self._lose(f"has gone ({error})")
            return ()
        return message.encode().split(b"\n") if isinstance(message, str) else (bytes(message),)
