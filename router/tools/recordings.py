"""Recordings made from a running router's tap, and recordings that are sent again."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic_ns, time_ns

from router.compiler.network import arrival
from router.errors import TransportError, UsageError, did_you_mean
from router.net.addresses import host_and_port
from router.observe.tap import Lost
from router.recording.about import about
from router.recording.channels import Channels
from router.recording.encoder import Batch, Clock, Encoder
from router.recording.mirror import Action, Classifier, MirroredDatagram
from router.recording.reader import Recorded, Recording
from router.recording.recorder import PERIOD
from router.recording.writer import RecordingFile
from router.table.addresses import Address
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint, Listener
from router.tools import links, udp
from router.tools.link_end import LinkEnd
from router.types.table_envelopes import Envelopes

MOST_SOCKETS = 256


class TapRecording:
    """A file, complete once it is closed; `datagrams` and `missed` are counts. Raises UsageError if it cannot write."""

    def __init__(self, path: Path, envelopes: Envelopes, table: RouteTable) -> None:
        self.path = path
        self.datagrams = self.missed = 0
        channels = Channels()
        self._clock = Clock()
        self._encoder = Encoder(channels)
        self._waiting: list[Batch] = []
        self._classifier = Classifier(envelopes, table)
        self._written_at = monotonic_ns()
        try:
            self._file = RecordingFile(path, channels, about(table, "router record"))
        except FileExistsError:
            raise UsageError(f"{path} already exists", "choose another name") from None
        except OSError as error:
            remedy = (
                f"make the folder {path.parent}" if isinstance(error, FileNotFoundError) else "make its folder writable"
            )
            raise UsageError(f"cannot write {path}: {error.strerror}", f"{remedy}, or choose another by -o") from error

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return self._file.size

    def take(self, batch: Iterable[MirroredDatagram | Action | Lost]) -> None:
        """Add a batch. Call this every second, also with an empty batch, so that earlier ones are written."""
        datagrams: list[MirroredDatagram] = []
        actions: list[Action] = []
        for mirrored in batch:
            if isinstance(mirrored, Lost):
                self.missed += mirrored.number
            elif isinstance(mirrored, Action):
                actions.append(mirrored)
            else:
                datagrams.append(mirrored)
        self.datagrams += len(datagrams)
        if datagrams or actions:
            now = monotonic_ns()
            times = now, *self._clock.times(time_ns(), now)
            self._waiting.append(Batch(datagrams, actions, self._classifier, *times))
        if monotonic_ns() - self._written_at >= PERIOD:
            self._write()

    def close(self) -> None:
        """Write the remaining data, and the index for readers."""
        self._write()
        try:
            self._file.close()
        except OSError as error:
            raise UsageError(f"{self.path} could not be finished: {error.strerror}") from error

    def _write(self) -> None:
        self._written_at = monotonic_ns()
        if not self._waiting:
            return
        waiting, self._waiting = self._waiting, []
        try:
            self._file.write(message for batch in waiting for message in self._encoder.messages(batch))
        except OSError as error:
            raise UsageError(f"cannot continue writing {self.path}: {error.strerror}") from error


def on_time(recording: Recording, speed: float) -> Iterator[Recorded]:
    """Yield each datagram when it is due; at an infinite speed, without waiting.

    Changes of the wall clock during the recording have no effect.
    """
    start, first = 0.0, None
    for datagram in recording.datagrams():
        if first is None:
            start, first = time.monotonic(), datagram.steady  # not before: opening a large recording takes time
        wait = start + (datagram.steady - first) / 1e9 / speed - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        yield datagram


@dataclass(slots=True)
class Resent:
    """What was sent. `refused` counts ICMP answers that the destination port is closed.

    `elsewhere` has the senders whose address this computer does not have, with that address.
    """

    datagrams: int = 0
    refused: int = 0
    elsewhere: dict[str, str] = field(default_factory=dict)


class Replayer:
    """Sends to `to`, or to the listener's address in `table`; from `origin`, or from the sender's address.

    The sender's address is that of the endpoint in `table`, else the recorded one. If this computer does not have it,
    any address is used, and `resent` names the sender. At each link of `table`, it is the boards, unless there is
    `to`.
    """

    def __init__(self, table: RouteTable | None, to: Address | None, origin: Address | None) -> None:
        self.resent = Resent()
        self._table = table
        self._to = to
        self._origin = origin
        self._sockets: dict[tuple[str, tuple[str, int], str], socket.socket] = {}
        self._ends: dict[str, dict[str, LinkEnd | UsageError]] = {}
        """The ends of boards by listener and endpoint, or why there is none: the recording may have nothing from it."""
        if table is not None and to is None:
            self._ends = {
                link.name: {board.name: _board_end(link, board) for board in links.boards_at(link, table)}
                for link in table.links
            }

    @property
    def ends(self) -> list[LinkEnd]:
        return [end for ends in self._ends.values() for end in ends.values() if isinstance(end, LinkEnd)]

    def send(self, datagram: Recorded) -> None:
        """Send a datagram or frame. Raises UsageError if its listener is nowhere, TransportError if sending fails."""
        datagram = self._moved(datagram)
        if (ends := self._ends.get(datagram.listener)) is not None:
            links.send_once(_end_of(ends, datagram), datagram.data)
            self.resent.datagrams += 1
            return
        key = (datagram.listener, datagram.peer, datagram.endpoint)
        if key not in self._sockets:
            if len(self._sockets) >= MOST_SOCKETS:
                self._close_sockets()
            self._sockets[key] = self._open(datagram)
        sender = self._sockets[key]
        try:
            self.resent.refused += udp.send_once(sender, datagram.data)
        except OSError as error:
            raise udp.cannot_send(Address(*host_and_port(sender.getpeername())), error) from error
        self.resent.datagrams += 1

    def _moved(self, datagram: Recorded) -> Recorded:
        """Return a datagram with the listener at which the table has its sender, if that is at a link or was."""
        if self._table is None or self._to is not None:
            return datagram
        place = arrival(self._table, datagram.listener, datagram.peer, datagram.endpoint)
        return datagram._replace(listener=place[0], peer=place[1]) if place is not None else datagram

    def close(self) -> None:
        self._close_sockets()
        for end in self.ends:
            end.close()

    def _close_sockets(self) -> None:
        for sender in self._sockets.values():
            if sender.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                self.resent.refused += 1
            sender.close()
        self._sockets.clear()

    def _open(self, datagram: Recorded) -> socket.socket:
        to = self._destination(datagram.listener)
        sender = self._bound(datagram, to)
        try:
            udp.connect(sender, to)
        except TransportError:
            sender.close()
            raise
        return sender

    def _destination(self, listener: str) -> Address:
        if self._to is not None:
            return self._to
        listeners = self._table.listeners if self._table is not None else {}
        if listener not in listeners:
            hint = did_you_mean(listener, listeners)
            raise UsageError(f"the table does not have the listener '{listener}' of the recording", hint or "give --to")
        return udp.listener_address(listeners[listener])

    def _bound(self, datagram: Recorded, to: Address) -> socket.socket:
        if self._origin is not None:
            return udp.open_udp(udp.origin_of(to, self._origin), "--from")
        wanted = Address(*datagram.peer)
        if self._table is not None and datagram.endpoint in self._table.endpoints:
            wanted = udp.origin(datagram.endpoint, self._table)
        for address in (wanted, wanted._replace(port=0)):
            try:
                return udp.open_udp(udp.origin_of(to, address), datagram.endpoint)
            except UsageError:
                continue
        self.resent.elsewhere[datagram.endpoint or str(Address(*datagram.peer))] = wanted.host
        return udp.open_udp(udp.origin_of(to), "replay")


def _board_end(link: Listener, board: Endpoint) -> LinkEnd | UsageError:
    try:
        return links.board_end(link, board)
    except UsageError as error:
        return error


def _end_of(ends: Mapping[str, LinkEnd | UsageError], datagram: Recorded) -> LinkEnd:
    """Return the end of the board that has sent a frame, or the only one at the link. Raises UsageError."""
    end = ends.get(datagram.endpoint) or (next(iter(ends.values())) if len(ends) == 1 else None)
    if end is None:
        what = f"the table has no endpoint '{datagram.endpoint}' at '{datagram.listener}'"
        raise UsageError(what, did_you_mean(datagram.endpoint, ends) or "name the table of the recording with -t")
    if isinstance(end, UsageError):
        raise end
    return end
