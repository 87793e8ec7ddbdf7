"""A gateway's TCP port: packets or lines of JSON."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from router.gateway.packets import PacketError
from router.table.addresses import Address
from router.table.model import GatewayFormat
from router.tools.listening_connected import ConnectedSource
from router.tools.listening_streams import Splitter

_READ_SIZE = 1 << 18


class TcpSource(ConnectedSource):
    """`form` is gateway_v1 or json_lines; None to see from the first bytes."""

    def __init__(self, address: Address, form: GatewayFormat | None, say: Callable[[str], None]) -> None:
        super().__init__("tcp", address, say)
        self._form = form

    def _open(self, opened: socket.socket, connected: ExitStack) -> None:
        self._socket = opened
        self._splitter = Splitter(self._form)

    def _receive(self, timeout: float) -> Sequence[bytes]:
        self._socket.settimeout(timeout)
        received: list[bytes] = []
        try:
            data = self._socket.recv(_READ_SIZE)
            for one in self._splitter.feed(data):
                received.append(one)  # noqa: PERF402 - what is whole counts, though the next be none
        except TimeoutError:
            return ()
        except (OSError, PacketError) as error:
            self._lose(f"is left ({error})")
        else:
            if not data:
                unfinished = self._splitter.unfinished
                self._lose(f"has gone, after {unfinished} bytes of a message" if unfinished else "has gone")
        return received
