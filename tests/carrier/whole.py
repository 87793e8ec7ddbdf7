"""The carrier and the Python threads behind it on clocks that are set, beside the engine that does all in Python."""

from __future__ import annotations

import ctypes
import random
import socket
from collections.abc import Callable, Mapping, Sequence
from ctypes import POINTER, c_int, c_int64, c_size_t, c_uint32, c_void_p
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from benchmarks.fuzz_engine import MUTATIONS
from router.app.parts import OF_PYTHON, Part, divided
from router.carrier import structures as c
from router.carrier.boards import NativeBoards
from router.carrier.build import NATIVE, compile_c, sources
from router.carrier.collectors import kept_collector
from router.carrier.deadmen import Deadmen, NativeDeadman
from router.carrier.deferrals import Adoption, Deferrals, timer_change
from router.carrier.library import load
from router.carrier.limits import open_limit
from router.carrier.outlets import Names, Outlets, PartTargets
from router.carrier.program import native_program
from router.carrier.ring import Ring
from router.carrier.sender import NativeSender
from router.compiler.program import Handler, Program, TargetPlan
from router.engine import PartEngine
from router.engine.binding import State
from router.engine.freshness import Born
from router.types.framing import MAX_DATAGRAM
from tests.carrier.building import sanitizing
from tests.carrier.commanding import Serialized
from tests.carrier.datagrams import Maker
from tests.engine.rig import HEAD, Ledger, Rig, program
from tests.engine.test_both_directions import enveloped

MS = 1_000_000
_PUBLISH = ctypes.CFUNCTYPE(c_int, c_void_p, POINTER(Serialized), c_void_p)
HERE = Path(__file__).parent

WHOLE_HEAD = HEAD.replace(
    "routes:\n",
    """\
  paced: {address: 192.168.0.70:9000, kind: tool, bandwidth: 2kB/s}
  refused: {address: 192.168.0.80:9000, kind: tool}
  picky: {address: 192.168.0.81:9000, kind: tool, listener: exact}
  arm_board: {address: 192.168.0.223:8, kind: board, trim_trailing_zeros: true}
routes:
""",
)
_FLOAT = "type: std_msgs/msg/Float32, fields: {data: "
_BRAKE = "timeout: 300ms, send: {manual_brake: {brake: true}}"
WHOLE = f"""\
  imu_info:
    - source: sensor_board
      destinations:
        - {{endpoint: basestation, when: 1 / accel_y > accel_x or accel_z > 1}}
        - {{endpoint: refused, max_rate: 20 Hz, when: source == "sensor_board"}}
        - arm_board
      topics:
        - {{topic: accel, {_FLOAT}accel_x}}, max_rate: 15 Hz}}
        - {{topic: inverse, {_FLOAT}"1 / accel_y"}}, when: accel_x < 5}}
        - {{topic: unwanted, {_FLOAT}accel_z}}}}
      ttl: 200ms
    - source: [left_tool, right_tool, picky]
      destinations:
        - recorder
        - {{endpoint: paced, when: accel_x > 1}}
        - {{endpoint: driving_board, when: source == "left_tool"}}
      topics: [{{topic: of_tools, {_FLOAT}accel_x}}}}]
  gps_info:
    source: any
    destinations: [basestation, paced]
    topics: [{{topic: unwanted_too, {_FLOAT}hdop}}}}]
  ph_info:
    source: any
    destinations: [{{endpoint: recorder, max_rate: 10 Hz, on_limit: latest}}]
    topics: [{{topic: ph, {_FLOAT}1 / ph_value}}, max_rate: 10 Hz, on_limit: latest}}]
    ttl: 400ms
  drive_diag: {{source: any, destinations: [{{endpoint: basestation, max_rate: 12 Hz}}, arm_board]}}
  arm_diag: {{ignore: nobody wants it}}
  manual_drive:
    source: [basestation, left_tool]
    destinations: [{{endpoint: driving_board, when: turn != 0 or forward_backward > -5}}, recorder]
    ttl: 200ms
    deadman: {{{_BRAKE}, to: [driving_board, recorder], repeat: 70ms, disarmed_by: [manual_arm]}}
  manual_arm:
    source: [basestation]
    destinations: [driving_board, refused]
    ttl: 150ms
    deadman: {{{_BRAKE}, to: [driving_board, refused], repeat: 110ms}}
  pressure_info:
    source: sensor_board
    destinations: [basestation]
    collect: {{by: round(pressure_kpa), count: 2, order: sensor_index, timeout: 50ms}}
    topics:
      - {{topic: both, {_FLOAT}"items[1].pressure_kpa"}}}}
      - {{topic: unwanted_frames, {_FLOAT}pressure_kpa}}}}
      - {{topic: inverse_frames, {_FLOAT}"1 / items[1].pressure_kpa"}}, when: pressure_kpa < 5}}
    ttl: 200ms
"""
UNWANTED = frozenset({"unwanted", "unwanted_too", "unwanted_frames"})
PEERS = (
    *3 * (("192.168.0.30", 8),), ("192.168.0.30", 9),
    ("192.168.0.222", 8), ("192.168.0.10", 9000), ("192.168.0.20", 9000),
    ("192.168.0.60", 8001), ("192.168.0.60", 8002), ("192.168.0.60", 8003), ("192.168.0.81", 9000),
    ("192.168.0.99", 1), ("0.0.0.0", 0), ("255.255.255.255", 65535),
)  # fmt: skip


def table(folder: Path) -> Program:
    return program(folder, WHOLE, WHOLE_HEAD)


def library(output: Path, sanitizers: str = "") -> ctypes.CDLL:
    """The carrier with clocks that are set, and `seam_handle`. With `sanitizers`, processes must preload libasan."""
    files = [HERE / "handling.c", *(path for path in sources() if path.name not in {"publish.c", "receive.c"})]
    flags = sanitizing(sanitizers) if sanitizers else ["-O2"]
    flags += ["-fPIC", "-shared", "-include", str(HERE / "clocked.h"), f"-I{NATIVE}"]
    compile_c([*flags, *map(str, files), "-o", str(output)], "gcc" if sanitizers else None)
    loaded = load(output)
    loaded.carrier_adopt_first.restype, loaded.carrier_adopt_first.argtypes = None, (c_void_p, c_void_p)
    loaded.seam_next_due.restype, loaded.seam_next_due.argtypes = c_int64, (c_void_p,)
    loaded.seam_handle.restype = None
    loaded.seam_handle.argtypes = (c_void_p, c_uint32, ctypes.c_char_p, c_size_t, c_uint32, c_uint32, c_int64)
    loaded.seam_publish_timers.restype, loaded.seam_publish_timers.argtypes = c_void_p, (c_void_p,)
    loaded.seam_publish_open.restype = c_void_p
    loaded.seam_publish_open.argtypes = (c_void_p, c_void_p, c_void_p, _PUBLISH)
    loaded.seam_publish.restype, loaded.seam_publish.argtypes = None, (c_void_p,)
    loaded.seam_publish_close.restype, loaded.seam_publish_close.argtypes = None, (c_void_p,)
    return loaded


class _Publication:
    """As `ros.endpoints.Publication`; `address` says to the callback which topic it is."""

    def __init__(self, number: int, is_wanted: bool) -> None:
        self.address = number
        self.wanted = (ctypes.c_uint8 * 1)(is_wanted)


class _Destination:
    """A sender of the carrier to a socket that is read here, or to none."""

    def __init__(self, loaded: ctypes.CDLL, refuses: bool) -> None:
        self._library = loaded
        self._socket, self._peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._peer.setblocking(False)
        self.refuses = refuses
        if refuses:
            self._peer.close()
        self.address: int = loaded.sender_open(self._socket.fileno(), -1, 0, 0)

    def send(self, data: bytes) -> int:
        if error := self._library.sender_send(self.address, data, len(data)):
            raise OSError(error, "refused")
        return len(data)

    def take(self) -> list[bytes]:
        taken: list[bytes] = []
        while not self.refuses:
            try:
                taken.append(self._peer.recv(MAX_DATAGRAM + 1))
            except BlockingIOError:
                break
        return taken

    def close(self) -> None:
        self._library.sender_close(self.address)
        self._socket.close()
        self._peer.close()


class Whole:
    """As `Rig`: `sent` by endpoint and `published` by topic are what came out of it.

    `publishes`: the carrier publishes what it can, else Python all.
    """

    def __init__(
        self, loaded: ctypes.CDLL, made: Program, *, publishes: bool, unwanted: frozenset[str] = UNWANTED
    ) -> None:
        self._library, self._program = loaded, made
        self._names = Names()
        self._clock, self._wall = (c_int64.in_dll(loaded, name) for name in ("seam_boottime", "seam_wall"))
        self._rig = Rig(made, unwanted)  # for its timers and topics
        size = len(made.counters.fresh_counts())
        self._counts, self._publish_counts = (c_int64 * size)(), (c_int64 * size)()
        self._events = Ring(loaded, 1 << 18)
        self._destinations = {plan.name: _Destination(loaded, plan.name == "refused") for plan in made.senders}
        self._set_clocks()
        self._deadmen = Deadmen(loaded, self._counts, self._events, self._names)
        senders = cast("Mapping[str, NativeSender]", self._destinations)
        self._braking = {plan.route: self._deadmen.add(plan, made.counters, senders) for plan in made.deadmen}
        self._divided = divided(made, publishes=publishes)
        self._rings = {part: Ring(loaded, 1 << 17) for part in OF_PYTHON}
        self._parts = {part: self._engine(part) for part in OF_PYTHON}
        self._functions = {part: engine.functions() for part, engine in self._parts.items()}
        self._limits = State()
        bandwidths = {plan.name: plan.bandwidth for plan in made.senders if plan.bandwidth is not None}
        self._deferrals = Deferrals(loaded, State(), self._destinations, {}, bandwidths)
        self._topics = list(self._rig.wanted)
        publications = {
            topic: _Publication(number, topic not in unwanted) for number, topic in enumerate(self._topics, 1)
        }
        self._publish = _PUBLISH(self._published_natively)
        self._published = Ring(loaded, 1 << 17)
        self._publishing = loaded.seam_publish_open(
            self._published.address, self._publish_counts, self._events.address, self._publish
        )
        listening = SimpleNamespace(socket=SimpleNamespace(fileno=lambda: -1), is_inherited=False)
        self._native = native_program(
            made,
            1,
            Outlets(
                listeners=cast("Any", {plan.name: listening for plan in made.listeners}),
                senders={name: each.address for name, each in self._destinations.items()},
                publications=publications,
                feeds=lambda route, names: [(each.address, disarms) for each, disarms in self._feeds(route, names)],
                limit=self._limit,
                deferral=self._deferrals.deferral,
                collector=partial(kept_collector, loaded, State()),
                carried=lambda handler: self._divided[Part.SENT].get(handler.route, ()),
                parts=self._parts_of,
                names=self._names,
                boards=NativeBoards(made.boards),
            ),
        )
        self._carrier = loaded.carrier_open(self._deadmen.address, self._counts, self._events.address)
        pacers = [Adoption(pacer.address) for name in self._destinations if (pacer := self._deferrals.pacer(name))]
        of_topics = [each for each in self._native.adopted if each.is_topic]
        timers = timer_change([*pacers, *(each for each in self._native.adopted if not each.is_topic)], ())
        self._change = c.Change(program=ctypes.pointer(self._native.structure), timers=timers)
        self._change_of_topics = c.PublishChange(timers=timer_change(of_topics, ()), generation=1)
        loaded.publish_change(self._publishing, ctypes.byref(self._change_of_topics))
        loaded.carrier_adopt_first(self._carrier, ctypes.byref(self._change))
        self._numbers = {plan.name: number for number, plan in enumerate(made.listeners)}
        self.sent: dict[str, list[bytes]] = {name: [] for name in self._destinations}

    def close(self) -> None:
        for engine in self._parts.values():
            engine.close()
        self._library.carrier_close(self._carrier)
        self._library.seam_publish_close(self._publishing)
        self._braking.clear()
        for destination in self._destinations.values():
            destination.close()

    @property
    def published(self) -> list[tuple[str, bytes]]:
        return self._rig.published

    def receive(self, data: bytes, peer: tuple[str, int], listener: str, arrived_before: int) -> None:
        """`arrived_before` in ns. Then Python serves what it is handed."""
        address = int.from_bytes(socket.inet_aton(peer[0]), "big")
        arrived_at = self._rig.wall(self._rig.now - arrived_before)
        number = self._numbers[listener]
        self._library.seam_handle(self._carrier, number, data, len(data), address, peer[1], arrived_at)
        self._events.take()
        self._collect()
        for part in (Part.DESTINATIONS, Part.TOPICS):
            self._serve(part)
        self._library.seam_publish(self._publishing)
        self._events.take()

    def pass_time(self, ns: int) -> None:
        """Moves the clocks, and serves deadmen and timers when they are due."""
        until = self._rig.now + ns
        groups = self._deadmen.address, self._library.seam_publish_timers(self._publishing)
        while (due := min(map(self._library.seam_next_due, groups))) <= until:
            self._rig.pass_time(max(due - self._rig.now, 0))
            self._set_clocks()
            for group in groups:
                self._library.timers_serve(group, self._rig.now)
            self._events.take()
            self._collect()
        self._rig.pass_time(until - self._rig.now)
        self._set_clocks()
        self._collect()

    def set_clock(self, by: int) -> None:
        self._rig.set_clock(by)
        self._set_clocks()

    def counts(self) -> list[int]:
        """Those of all threads."""
        of_threads = zip(self._counts, self._publish_counts, self._rig.counts, strict=True)
        return [sum(counts) for counts in of_threads]

    def _set_clocks(self) -> None:
        self._clock.value, self._wall.value = self._rig.now, self._rig.wall(self._rig.now)

    def _collect(self) -> None:
        for name, destination in self._destinations.items():
            self.sent[name] += destination.take()

    # wiring, as in app/native_datapath.py

    def _engine(self, part: Part) -> PartEngine:
        send: dict[str, Callable[[bytes], int]] = {name: each.send for name, each in self._destinations.items()}
        context = replace(self._rig.context, send=send, command=self._command, state=State())
        return PartEngine(self._program, context, self._divided[part])

    def _command(self, endpoint: str, route: str, names: Sequence[str]) -> Callable[[bytes, int | None], int]:
        sender = cast("NativeSender", self._destinations[endpoint])
        return self._deadmen.command(sender, self._feeds(route, names))

    def _feeds(self, route: str, names: Sequence[str]) -> list[tuple[NativeDeadman, bool]]:
        return [(self._braking[name], name != route) for name in names]

    def _limit(self, handler: Handler, target: TargetPlan) -> c.Limit:
        rate, key = target.max_rate, (handler.route, target)
        assert rate is not None
        return self._limits.keep(key, lambda: open_limit(rate))

    def _published_natively(self, publisher: int, message: Any, _: object) -> int:
        """As a middleware."""
        cdr = ctypes.string_at(message.contents.buffer, message.contents.length)
        self._rig.published.append((self._topics[publisher - 1], cdr))
        return 0

    def _parts_of(self, handler: Handler) -> list[PartTargets]:
        parts = [
            PartTargets(
                self._rings[part].address,
                self._divided[part][handler.route],
                part is Part.DESTINATIONS or handler.collect_timeout is not None,
            )
            for part in OF_PYTHON
            if handler.route in self._functions[part]
        ]
        if targets := self._divided[Part.PUBLISHED].get(handler.route):
            collects = handler.collect_timeout is not None
            parts.append(PartTargets(self._published.address, targets, is_always_wanted=collects, is_native=True))
        return parts

    def _serve(self, part: Part) -> None:
        """As `Worker`."""
        records, position, head = self._rings[part].take(), 0, ctypes.sizeof(c.MessageRecord)
        while position < len(records):
            record = c.MessageRecord.from_buffer_copy(records, position)
            start = position + head
            datagram = bytes(records[start : start + record.length])
            first = start + record.start
            payload = bytes(records[first : first + record.payload_length]) if record.is_single else None
            function, waiting = self._functions[part][self._native.handlers[record.handler].route]
            source = self._native.sources[record.column]
            function(payload, datagram, record.received_at, record.now, source, Born(record.oldest, record.youngest))
            for index in waiting:
                self._rig.counts[index] -= 1
            position += record.size
            self._collect()


class Comparison:
    """The same datagrams, at the same times, to both. `publishes` is as in `Whole`."""

    def __init__(self, loaded: ctypes.CDLL, made: Program, seed: int, *, publishes: bool) -> None:
        self._noise = random.Random(seed)
        self._maker = Maker(made.envelope.message_class.DESCRIPTOR, self._noise)  # type: ignore[arg-type]  # or upb's
        self._program = made
        self.python, self.carrier = Rig(made, UNWANTED), Whole(loaded, made, publishes=publishes)
        self.python.failures["refused"] = ConnectionRefusedError("refused")

    def datagram(self) -> bytes:
        noise = self._noise
        if noise.random() < 0.3:
            return self._maker.datagram()
        if noise.random() < 0.001:
            return enveloped(imu_info={"accel_x": 1.0}).ljust(MAX_DATAGRAM + noise.randrange(-2, 2), b"\0")
        value = noise.choice((0.0, 0.0, 1.5, 7.0, 1e-40))
        data = enveloped(
            **noise.choice(
                (
                    {"imu_info": {"accel_x": value, "accel_y": noise.choice((0.0, 2.0)), "accel_z": 0.0}},
                    {"gps_info": {"hdop": value}},
                    {"ph_info": {"ph_value": value}},
                    {"drive_diag": {}},
                    {"arm_diag": {}},
                    {"manual_drive": {"turn": int(value)}},
                    {"manual_arm": {}},
                    {"pressure_info": {"sensor_index": noise.randrange(3), "pressure_kpa": value}},
                )
            )
        )
        return noise.choice(MUTATIONS)(noise, data, data) if data and noise.random() < 0.3 else data

    def step(self) -> str | None:
        """One datagram to both. Returns what differs, if anything."""
        noise, python, carrier = self._noise, self.python, self.carrier
        passes = noise.choice(
            (
                0,
                0,
                1,
                MS,
                MS,
                noise.randrange(2 * MS),
                noise.randrange(20 * MS),
                noise.randrange(20 * MS),
                noise.randrange(600 * MS),
            )
        )
        for each in (python, carrier):
            each.pass_time(passes)
        if noise.random() < 0.03:
            by = noise.choice((-1, 1)) * noise.choice((3 * MS, 50 * MS, noise.randrange(600 * MS), 3600 * 1000 * MS))
            for each in (python, carrier):
                each.set_clock(by)
        data, peer, listener = self.datagram(), noise.choice(PEERS), noise.choice(("trimmed", "exact"))
        python.arrived_before = noise.choice((0, noise.randrange(250 * MS)))
        python.receive(data, peer, listener)
        carrier.receive(data, peer, listener, python.arrived_before)
        if found := self._difference():
            return f"{data.hex()} of {peer} on {listener}, {python.arrived_before} ns old: {found}"
        return None

    def _difference(self) -> str | None:
        python, carrier = self.python, self.carrier
        sent: dict[str, list[bytes]] = {name: [] for name in carrier.sent}
        for name, data in python.sent:
            sent[name].append(data)
        python.sent.clear()
        found = [f"{name}: {carrier.sent[name]}, not {sent[name]}" for name in sent if carrier.sent[name] != sent[name]]
        for each in (carrier.published, python.published):
            each.sort(key=lambda published: published[0])  # several threads publish, each topic in order
        if carrier.published != python.published:
            found.append(f"published {carrier.published}, not {python.published}")
        for datagrams in carrier.sent.values():
            datagrams.clear()
        carrier.published.clear()
        python.published.clear()
        counts = carrier.counts()
        if counts != python.counts:
            found += [
                f"{series}: {counts[index]}, not {python.counts[index]}"
                for series, index in self._program.counters.series()
                if counts[index] != python.counts[index]
            ]
        return "; ".join(found) or None

    def fates(self) -> Mapping[tuple[str, ...], int]:
        return Ledger(self._program, self.python.counts).counted("messages", "datagrams", "deadman")


def compare(
    loaded: ctypes.CDLL, folder: Path, count: int, seed: int, *, publishes: bool
) -> tuple[str | None, Mapping[tuple[str, ...], int]]:
    """Give `count` datagrams to both. Returns the first difference, and what was counted in Python."""
    comparison = Comparison(loaded, table(folder), seed, publishes=publishes)
    try:
        for number in range(count):
            if found := comparison.step():
                return f"datagram {number}: {found}", comparison.fates()
    finally:
        comparison.carrier.close()
    return None, comparison.fates()
