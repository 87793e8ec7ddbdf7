"""Helpers for tests of recordings: datagrams of the rover, and a router that is only a mirror."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from hypothesis import strategies as st

from router.compiler.compiled_table import CompiledTable
from router.datagrams import Peer, Wire, wire_of_protos
from router.errors import Located, SourceSpan
from router.recording.channels import Channels
from router.recording.encoder import Batch, Encoder, Packer
from router.recording.mirror import Action, Classifier, Keeper, Mirror, MirroredDatagram
from router.recording.reader import Recorded, Recording
from router.recording.recorder import Recorder
from router.recording.writer import RecordingFile
from router.table.addresses import Address
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint, EndpointKind, Framing, Listener
from router.table.model.settings import RecordSettings
from tests.tables import PROTOS

SPAN = SourceSpan("table.yaml", 3)
START = 1_790_000_000_000_000_000
SENSOR_BOARD = ("10.0.0.3", 5000)
STRANGER = ("10.9.9.9", 40000)
NAMES = {SENSOR_BOARD: "sensor_board"}
MILLISECOND = 1_000_000


@cache
def wire() -> Wire:
    return wire_of_protos(PROTOS)


def imu(accel_x: float = 1.5) -> bytes:
    case = wire().case("imu_info")
    return wire().encode(case, case.message_class(accel_x=accel_x, accel_z=9.81))


@st.composite
def datagrams(draw: st.DrawFn) -> bytes:
    """Datagrams of boards, truncated ones, and garbage."""
    kind = draw(st.sampled_from(["bytes", "payload", "cut", "changed", "padded", "long length"]))
    if kind == "bytes":
        return draw(st.binary(max_size=300))
    case = draw(st.sampled_from(list(wire().envelopes.first.cases.values())))
    if kind == "long length":
        return bytes([case.number << 3 & 0x7F | 2, 0x80, 0]) if case.number < 16 else b"\x82\x01\x80\x00"
    exact = wire().encode(case, case.message_class())
    if kind == "payload":
        return exact
    whole = draw(st.sampled_from([exact, imu(draw(st.floats(width=32, allow_nan=False)))]))
    if kind == "cut":
        return whole[: draw(st.integers(0, len(whole)))]
    if kind == "padded":
        return whole + bytes(draw(st.integers(1, 40)))
    position = draw(st.integers(0, len(whole) - 1))
    return whole[:position] + bytes([draw(st.integers(0, 255))]) + whole[position + 1 :]


def endpoints() -> dict[str, Endpoint]:
    address = Located(Address(*SENSOR_BOARD), SPAN)
    return {"sensor_board": Endpoint("sensor_board", SPAN, address, kind=EndpointKind.BOARD, trim_trailing_zeros=False)}


def table(**changed: Any) -> RouteTable:
    """The part of a table that a recording contains."""
    listener = Listener("rover", SPAN, Located(Address("0.0.0.0", 5000), SPAN), framing=Framing.ZERO_TRIMMED)
    told = {
        "path": Path("routes/rover.yaml"),
        "endpoints": endpoints(),
        "listeners": {"rover": listener},
        "routes": (),
        "envelopes": {},
        **changed,
    }
    return cast("RouteTable", SimpleNamespace(**told))


@cache
def classifier() -> Classifier:
    return Classifier(wire().envelopes, table())


def shown(
    data: bytes, at: int = START, peer: Peer = SENSOR_BOARD, listener: str = "rover", reason: str = ""
) -> MirroredDatagram:
    """The mirror's record of a datagram."""
    return MirroredDatagram(at, listener, peer, NAMES.get(peer, ""), reason, data)


def seen(*datagrams: bytes, at: int = START, peer: Peer = SENSOR_BOARD, reason: str = "") -> list[MirroredDatagram]:
    """Records of datagrams, one per millisecond."""
    return [shown(data, at + number * MILLISECOND, peer, reason=reason) for number, data in enumerate(datagrams)]


def recorded(path: Path, *batches: Sequence[MirroredDatagram], finish: bool = True) -> Path:
    """A file with one chunk per batch, with a constant clock offset."""
    packer = Packer()
    return write(path, Channels(), *(batched(packer, batch) for batch in batches), finish=finish)


def batched(
    packer: Packer,
    datagrams: Sequence[MirroredDatagram],
    actions: Sequence[Action] = (),
    clocks: tuple[int, int] | None = None,
) -> Batch:
    """A batch, with a constant clock offset or with these `clocks`: wall and monotonic."""
    wall, monotonic = clocks or (datagrams[-1].at, datagrams[-1].at - START)
    return packer.pack(Listed(datagrams), Listed(actions), classifier(), wall, monotonic)


class Listed(list[Any]):
    """Datagrams or actions, as the mirror's keepers get them."""

    @property
    def records(self) -> bytes:
        return pickle.dumps([*self]) if self else b""

    def decode(self, records: bytes) -> Iterator[Any]:
        return iter(pickle.loads(records) if records else ())  # noqa: S301 - what it has dumped


ABOUT = {"reason": "test"}


def write(
    path: Path, channels: Channels, *batches: Batch, finish: bool = True, metadata: Mapping[str, str] = ABOUT
) -> Path:
    file, encoder = RecordingFile(path, channels, {**metadata}), Encoder(channels)
    for batch in batches:
        file.write(encoder.messages(batch))
    if finish:
        file.close()
    else:
        os.close(file._output.descriptor)
    return path


def read(path: Path) -> list[Recorded]:
    with closing(Recording(path)) as recording:
        return list(recording.datagrams())


def again(found: Recorded) -> MirroredDatagram:
    """The recorded datagrams, as the mirror showed them."""
    return MirroredDatagram(found.at, found.listener, found.peer, found.endpoint, found.reason, found.data)


class FakeMirror:
    """Shows a test's datagrams at once, as of a router that runs `program`."""

    def __init__(self) -> None:
        self.keeper: Keeper = print
        self.program = SimpleNamespace(table=table(), envelopes=wire().envelopes, protos_sha256="0" * 64)

    def keep(self, keeper: Keeper) -> Callable[[], None]:
        self.keeper = keeper
        return lambda: None

    def show(self, datagrams: Sequence[MirroredDatagram]) -> None:
        self.keeper(Listed(datagrams), Listed())

    def act(self, actions: Sequence[Action]) -> None:
        self.keeper(Listed(), Listed(actions))

    def deliver(self, patience: float) -> bool:
        """Nothing waits."""
        return patience > 0


def recorder(mirror: FakeMirror, settings: RecordSettings) -> Recorder:
    return Recorder(cast("Mirror", mirror), lambda: cast("CompiledTable", mirror.program), settings)


def settings(directory: Path, **changed: Any) -> RecordSettings:
    told: dict[str, Any] = {
        "continuous": True,
        "last": None,
        "max_size": 256 << 20,
        "max_age": 600 * 10**9,
        "retention": 4 << 30,
        **changed,
    }
    return RecordSettings(SPAN, directory, **told)
