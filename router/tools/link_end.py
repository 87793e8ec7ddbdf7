"""One end of a link, for tools: frames on a descriptor that does not block."""

from __future__ import annotations

import errno
import os
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from router.carrier.frames import Codec, Frame
from router.errors import TransportError
from router.image.openings import framing_of
from router.net.links import why_closed
from router.net.ready import await_room
from router.tools.tap import PATIENCE

if TYPE_CHECKING:
    from router.table.model.endpoints import Listener

READ_AT_ONCE = 65536

OPENED_WITHIN = 0.02
"""Seconds after which it is noticed that the other end has opened a link."""

READ_WITHIN = 0.2
"""Seconds in which the other end reads what was sent, which closing may discard."""


class LinkEnd:
    """One end of a link. It does not block, except where it says so. `name` and `place` are for people."""

    opens_again = False
    """Whether it opens again after the other end has closed the link."""
    end_of_stream = errno.EIO
    """What `receive` raises at the end of the stream."""

    def __init__(self, link: Listener, fd: int, place: str) -> None:
        assert link.link is not None  # noqa: S101 - checked by the caller
        self.name = link.name
        self.place = place
        self._fd = fd
        self._codec = Codec(framing_of(link.link))
        self._rest = b""

    @property
    def is_open(self) -> bool:
        """Whether somebody is at the other end."""
        return True

    @property
    def awaited(self) -> str:
        """What `await_open` waits for, such as "the router to open /tmp/uart"; "" if that is not for long."""
        return ""

    @property
    def where(self) -> str:
        """Where it listens, as in "listening to /dev/ttyS0"."""
        raise NotImplementedError

    def __str__(self) -> str:
        return self.place

    def await_open(self) -> None:
        """Wait until it is open. May raise TransportError."""
        while not self.is_open:
            time.sleep(OPENED_WITHIN)

    def fileno(self) -> int:
        return self._fd

    def send(self, payload: bytes) -> None:
        """Send a frame. Raises BlockingIOError if an earlier one is still waiting, OSError if it cannot be sent."""
        self._flush()
        if self._rest:
            raise BlockingIOError(errno.EAGAIN, "the line is full")
        self._rest = self._codec.write(payload)
        if not self._rest:
            raise OSError(errno.EMSGSIZE, os.strerror(errno.EMSGSIZE))
        self._flush()

    def finish(self) -> None:
        """Wait until what was sent has left. Raises OSError."""
        while self._rest:
            await_room(self._fd, PATIENCE)
            self._flush()

    def _flush(self) -> None:
        with suppress(BlockingIOError):
            self._rest = self._rest[os.write(self._fd, self._rest) :]

    def receive(self) -> list[Frame]:
        """Return the frames that are complete with the bytes that have arrived. Raises OSError at the stream's end."""
        try:
            data = os.read(self._fd, READ_AT_ONCE)
        except BlockingIOError:
            return []
        if not data:
            raise OSError(self.end_of_stream, os.strerror(self.end_of_stream))
        return [*self._codec.read(data)]

    def ended(self, error: OSError) -> TransportError:
        """Return the failure of a tool that cannot go on after this error."""
        if error.errno == errno.EMSGSIZE:
            return TransportError(f"'{self.name}': its framing has no length for so many bytes")
        why, remedy = why_closed(error.errno or 0)
        return TransportError(f"'{self.name}' is closed: {why}", remedy)

    def _begin(self) -> None:
        """Begin another stream."""
        self._codec.begin()
        self._rest = b""

    def close(self) -> None:
        os.close(self._fd)
