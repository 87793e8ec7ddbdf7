"""Listeners that are TCP connections: the router connects to a board, or boards connect to the router."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from router.errors import Located, SourceSpan
from router.table.addresses import LOCAL, REMOTE, Address
from router.table.keys import Shape
from router.table.model.serial import Checksum, StreamFraming


@dataclass(frozen=True, slots=True)
class TcpClient:
    """A TCP connection to a board. Each frame on it has one envelope.

    `span` is the listener's name in the table.
    """

    NOUN: ClassVar[str] = "TCP connection"

    span: SourceSpan
    connect: Annotated[Located[Address], REMOTE]
    """The address that the router connects to, again each second while it is not connected.

    Title: Server address
    Example: 10.0.0.2:10008
    """
    framing: Annotated[StreamFraming, Shape("stream_framing")]
    checksum: Annotated[Checksum | None, Shape("checksum")] = None
    envelope: Located[str] | None = None
    """Which of the table's `envelopes` its frames are. Needed if there are several.

    Example: vision
    """


@dataclass(frozen=True, slots=True)
class TcpServer:
    """A TCP server that boards connect to. Each frame has one envelope.

    `span` is the listener's name in the table.
    """

    NOUN: ClassVar[str] = "TCP server"

    span: SourceSpan
    accept: Annotated[Located[Address], LOCAL]
    """The local address to listen at. Endpoints that name this listener may connect, each once: a second connection
    from an address replaces the first one. All others are refused.

    Title: Server address
    Example: 0.0.0.0:4444
    """
    framing: Annotated[StreamFraming, Shape("stream_framing")]
    checksum: Annotated[Checksum | None, Shape("checksum")] = None
    envelope: Located[str] | None = None
    """Which of the table's `envelopes` its frames are. Needed if there are several.

    Example: vision
    """
