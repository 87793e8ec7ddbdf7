"""Finds and loads the carrier's library, which `build.py` makes, and declares its functions.

A library of other sources than those beside it is refused: its structures may differ from those in `structures.py`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from ctypes import POINTER, c_bool, c_char_p, c_int, c_int64, c_size_t, c_uint16, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path

from router.assets import asset, is_installed
from router.carrier import structures
from router.carrier.build import LIBRARY, checksum
from router.errors import StartError

FUNCTIONS: Mapping[str, tuple[type | None, tuple[type, ...]]] = {
    "board_takes": (c_bool, (c_void_p, c_void_p, c_size_t, c_void_p)),
    "carrier_change": (None, (c_void_p, c_void_p)),
    "carrier_close": (None, (c_void_p,)),
    "carrier_counters": (c_bool, (c_void_p, c_void_p, c_uint32)),
    "carrier_mirror": (None, (c_void_p, c_void_p, c_uint32)),
    "carrier_open": (c_void_p, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "carrier_pulse": (None, (c_void_p,)),
    "carrier_start": (c_int, (c_void_p, c_void_p)),
    "carrier_stop_receiving": (None, (c_void_p,)),
    "carrier_turns": (c_uint64, (c_void_p,)),
    "carrier_watchdog": (None, (c_void_p, c_int, c_int64)),
    "client_deadmen_advance": (None, (c_void_p, c_uint32)),
    "client_deadmen_group": (c_void_p, (c_void_p,)),
    "client_deadmen_have_reached": (c_bool, (c_void_p, c_uint32)),
    "client_deadmen_open": (c_void_p, (c_void_p, c_void_p)),
    "client_deadmen_since": (c_int64, (c_void_p, c_void_p)),
    "client_deadmen_start": (c_int, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "client_deadmen_stop": (c_bool, (c_void_p,)),
    "collector_close": (None, (c_void_p,)),
    "collector_open": (c_void_p, (c_int64,)),
    "command_send": (c_int, (c_void_p, c_void_p, c_void_p, c_size_t, c_int64, c_void_p, c_uint32)),
    "command_send_at": (c_int, (c_void_p, c_void_p, c_void_p, c_size_t, c_int64, c_void_p, c_uint32, c_int64)),
    "deadman_await_subscribers": (None, (c_void_p, c_void_p, c_int64)),
    "condition_holds": (c_int, (c_void_p, c_void_p, c_void_p, c_int64, c_void_p, c_size_t, c_void_p)),
    "deadman_close": (None, (c_void_p, c_void_p)),
    "deadman_end_by_thread": (None, (c_void_p, c_void_p)),
    "deadman_feed": (None, (c_void_p, c_void_p, c_int64)),
    "deadman_greet": (c_bool, (c_void_p, c_void_p, c_int64)),
    "deadman_open": (
        c_void_p,
        (c_void_p, c_int64, c_int64, c_bool, c_uint32, c_uint32, c_uint32, c_void_p, c_uint32),
    ),
    "deadman_replace": (None, (c_void_p, c_void_p, c_void_p)),
    "deadman_start": (c_uint64, (c_void_p, c_void_p, c_int64)),
    "deferral_close": (None, (c_void_p,)),
    "deferral_open": (c_void_p, (c_void_p,)),
    "envelope_read": (c_int, (c_void_p, c_void_p, c_size_t, c_bool, c_void_p)),
    "freshness_born": (structures.Born, (c_void_p, c_int64, c_int64, c_int64, c_int64)),
    "freshness_look": (None, (c_void_p, c_int64, c_int64)),
    "from_ros_counters": (c_bool, (c_void_p, c_void_p, c_uint32)),
    "from_ros_failures": (c_uint64, (c_void_p,)),
    "from_ros_follow": (None, (c_void_p, c_void_p)),
    "from_ros_open": (c_void_p, (c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_bool)),
    "from_ros_serve": (c_bool, (c_void_p, c_void_p)),
    "from_ros_stop": (c_bool, (c_void_p,)),
    "from_ros_unwatch": (None, (c_void_p, c_int)),
    "from_ros_watch": (c_int, (c_void_p, c_int)),
    "limit_passes": (c_bool, (c_void_p, c_int64)),
    "pacer_close": (None, (c_void_p,)),
    "pacer_open": (c_void_p, (c_int64,)),
    "publish_advance": (None, (c_void_p, c_uint32)),
    "publish_change": (None, (c_void_p, c_void_p)),
    "publish_counters": (c_bool, (c_void_p, c_void_p, c_uint32)),
    "publish_has_reached": (c_bool, (c_void_p, c_uint32)),
    "publish_open": (c_void_p, (c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p)),
    "publish_since": (c_int64, (c_void_p, c_void_p)),
    "publish_stop": (c_bool, (c_void_p,)),
    "rcl_types_differ": (c_bool, ()),
    "rehearsal_adopt": (None, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "rehearsal_advance": (None, (c_void_p, c_int64)),
    "rehearsal_close": (None, (c_void_p,)),
    "rehearsal_datagram": (None, (c_void_p, c_uint32, c_uint32, c_uint32, c_void_p, c_size_t, c_int64)),
    "rehearsal_end": (None, (c_void_p,)),
    "rehearsal_message": (None, (c_void_p, c_uint32, c_void_p, c_size_t, c_int64)),
    "rehearsal_open": (c_void_p, (c_void_p, c_int64)),
    "rehearsal_records": (c_void_p, (c_void_p, c_void_p)),
    "rehearsal_set_clock": (None, (c_void_p, c_int64)),
    "rehearsal_timers": (c_void_p, (c_void_p,)),
    "ring_close": (None, (c_void_p,)),
    "ring_drop": (c_bool, (c_void_p, c_void_p, c_size_t)),
    "ring_open": (c_void_p, (c_size_t,)),
    "ring_put": (c_bool, (c_void_p, c_void_p, c_uint32)),
    "ring_take": (c_size_t, (c_void_p, c_void_p, c_size_t, c_int64)),
    "ring_taken": (c_uint64, (c_void_p,)),
    "ring_wake": (None, (c_void_p,)),
    "ring_watch": (c_int, (c_void_p,)),
    "ring_written": (c_uint64, (c_void_p,)),
    "sender_close": (None, (c_void_p,)),
    "sender_end": (None, (c_void_p,)),
    "sender_move": (None, (c_void_p, c_int, c_int)),
    "sender_note_errors": (c_bool, (c_int,)),
    "sender_open": (c_void_p, (c_int, c_int, c_uint32, c_uint16)),
    "sender_send": (c_int, (c_void_p, c_void_p, c_size_t)),
    "sender_send_checked": (c_int, (c_void_p, c_void_p, c_size_t)),
    "timer_end": (None, (c_void_p, c_void_p)),
    "timers_change": (None, (c_void_p, c_void_p)),
    "timers_close": (None, (c_void_p,)),
    "timers_end": (None, (c_void_p,)),
    "timers_open": (c_void_p, (c_void_p, c_void_p)),
    "timers_serve": (None, (c_void_p, c_int64)),
}
"""What each function of the headers returns and takes. Any pointer is a c_void_p, which also takes bytes and arrays."""

STRUCTURES: Mapping[str, type[ctypes.Structure]] = {
    "board": structures.Board,
    "board_field": structures.BoardField,
    "board_message": structures.BoardMessage,
    "adoption": structures.Adoption,
    "born": structures.Born,
    "change": structures.Change,
    "closed_enum": structures.ClosedEnum,
    "code": structures.Code,
    "collect": structures.Collect,
    "deadman_destination": structures.DeadmanDestination,
    "entry": structures.Entry,
    "feed": structures.Feed,
    "for_each": structures.ForEach,
    "freshness": structures.Freshness,
    "layout": structures.Layout,
    "limit": structures.Limit,
    "listener": structures.Listener,
    "message_record": structures.MessageRecord,
    "mirror_record": structures.MirrorRecord,
    "node": structures.Node,
    "node_field": structures.NodeField,
    "operation": structures.Operation,
    "payload_case": structures.Case,
    "peer": structures.Peer,
    "program": structures.Program,
    "publish_change": structures.PublishChange,
    "read_operation": structures.ReadOperation,
    "ros_route": structures.RosRoute,
    "ros_set": structures.RosSet,
    "ros_topic": structures.RosTopic,
    "route": structures.Route,
    "setting": structures.Setting,
    "target": structures.Target,
    "targets": structures.Targets,
    "timer_change": structures.TimerChange,
    "topic": structures.Topic,
    "value": structures.Value,
    "wire_field": structures.WireField,
    "wire_schema": structures.Schema,
    "wire_type": structures.WireType,
}
"""The structures that both sides declare, by their names in C."""


class _StructureSize(ctypes.Structure):
    """`struct structure_size` in library.c."""

    _fields_ = (("name", c_char_p), ("size", c_size_t))


@cache
def library() -> ctypes.CDLL:
    """The library, loaded once. Raises StartError where it cannot be used."""
    return load()


def load(path: Path = LIBRARY) -> ctypes.CDLL:
    """Load the library, without which nothing runs, and declare its functions. Raises StartError."""
    if not path.exists():
        raise StartError(f"{path} was not built, and nothing runs without it", _remedy())
    try:
        library = ctypes.CDLL(str(path))
        made_of = _text(library.carrier_checksum)
    except (OSError, AttributeError) as error:  # of another architecture, or no such library at all
        raise StartError(f"{path} cannot be loaded: {error}", _remedy()) from None
    if made_of != checksum():
        raise StartError(f"{path} was built from other sources", _remedy())
    if differing := sorted(_differing_structures(library)):
        raise StartError(f"C and Python differ about struct {', '.join(differing)}", "correct structures.py")
    for name, (returned, taken) in FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = returned, taken
    return library


def _text(function: ctypes._NamedFuncPointer) -> str:
    function.restype = c_char_p
    return str(function().decode())


def _differing_structures(library: ctypes.CDLL) -> Iterator[str]:
    library.carrier_structure_sizes.restype = POINTER(_StructureSize)
    sizes = library.carrier_structure_sizes()
    found: dict[str, int] = {}
    while name := sizes[len(found)].name:
        found[name.decode()] = sizes[len(found)].size
    for name, structure in STRUCTURES.items():
        if found.pop(name, None) != ctypes.sizeof(structure):
            yield name
    yield from found


def _remedy() -> str:
    if is_installed(asset("schemas")):
        return "install the router again where there is a C compiler"
    return "run 'make setup'"
