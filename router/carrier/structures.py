"""The C structures that Python fills and reads, field by field as in `native/`. `library` compares their sizes."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_int32, c_int64, c_uint8, c_uint16, c_uint32, c_uint64, c_void_p

REASONS = 8
"""Reasons to reject a datagram: those of REJECT_REASONS, in the same order."""

LOSSES = (
    "mapping_error",
    "non_finite",
    "stale",
    "rate_limited",
    "queue_full",
    "send_buffer_full",
    "send_error",
    "publish_error",
    "too_large",
    "incomplete",
)
"""`enum loss` in events.h, as DROP_REASONS names them."""

NO_NAME = 0xFFFF_FFFF
"""In events: no name belongs here."""


class WireField(ctypes.Structure):
    """`struct wire_field` in envelope.h."""

    _fields_ = (("number", c_uint32), ("kind", c_uint8), ("flags", c_uint8), ("type", c_uint16))


class WireType(ctypes.Structure):
    """`struct wire_type` in envelope.h."""

    _fields_ = (("fields", POINTER(WireField)), ("count", c_uint32), ("accepts_zero", c_uint32))


class Schema(ctypes.Structure):
    """`struct wire_schema` in envelope.h."""

    _fields_ = (("types", POINTER(WireType)), ("count", c_uint32))


class Limit(ctypes.Structure):
    """`struct limit` in limit.h."""

    _fields_ = (("period", c_int64), ("late", c_int64), ("next_pass", c_int64))


class Feed(ctypes.Structure):
    """`struct feed` in deadman.h."""

    _fields_ = (("deadman", c_void_p), ("disarms", c_uint32), ("reserved", c_uint32))


class DeadmanDestination(ctypes.Structure):
    """`struct deadman_destination` in deadman.h."""

    _fields_ = (
        ("sender", c_void_p),
        ("datagram", ctypes.c_char_p),
        ("size", c_uint32),
        ("sent", c_uint32),
        ("send_errors", c_uint32),
        ("id", c_uint32),
        ("publisher", c_void_p),
    )


class BoardField(ctypes.Structure):
    """`struct board_field` in board.h."""

    _fields_ = (
        ("number", c_uint32),
        ("kind", c_uint8),
        ("flags", c_uint8),
        ("message", c_uint16),
        ("longest", c_uint32),
        ("most", c_uint32),
        ("counter", c_uint32),
        ("reserved", c_uint32),
        ("path", ctypes.c_char_p),
    )


class BoardMessage(ctypes.Structure):
    """`struct board_message` in board.h."""

    _fields_ = (
        ("fields", POINTER(BoardField)),
        ("count", c_uint32),
        ("first_counter", c_uint32),
        ("counter_count", c_uint32),
        ("reserved", c_uint32),
    )


class Board(ctypes.Structure):
    """`struct board` in board.h."""

    _fields_ = (("messages", POINTER(BoardMessage)), ("longest", c_uint32), ("allows_non_finite", c_uint32))


class Value(ctypes.Structure):
    """`struct value` in operations.h, with its union as bits."""

    _fields_ = (("bits", c_uint64), ("size", c_uint32), ("reserved", c_uint32))


class Operation(ctypes.Structure):
    """`struct operation` in operations.h, with its union as bits."""

    _fields_ = (("kind", c_uint8), ("flag", c_uint8), ("slot", c_uint16), ("size", c_uint32), ("bits", c_uint64))


class Code(ctypes.Structure):
    """`struct code` in operations.h."""

    _fields_ = (("operations", POINTER(Operation)), ("count", c_uint32), ("reserved", c_uint32))


class NodeField(ctypes.Structure):
    """`struct node_field` in operations.h."""

    _fields_ = (
        ("number", c_uint32),
        ("type", c_uint8),
        ("is_repeated", c_uint8),
        ("slot", c_uint16),
        ("presence", c_uint16),
        ("node", c_uint16),
        ("choice", c_uint16),
        ("cleared", c_uint16),
        ("cleared_count", c_uint16),
        ("closed", c_uint16),
    )


class ClosedEnum(ctypes.Structure):
    """`struct closed_enum` in operations.h."""

    _fields_ = (("numbers", POINTER(c_int32)), ("count", c_uint32), ("reserved", c_uint32))


class ReadOperation(ctypes.Structure):
    """`struct read_operation` in operations.h."""

    _fields_ = (
        ("kind", c_uint8),
        ("size", c_uint8),
        ("type", c_uint8),
        ("reserved", c_uint8),
        ("slot", c_uint16),
        ("padding", c_uint16),
        ("count", c_uint32),
    )


class Node(ctypes.Structure):
    """`struct node` in operations.h; `fields` of protobuf, or steps through CDR."""

    _fields_ = (
        ("fields", c_void_p),
        ("count", c_uint32),
        ("first_slot", c_uint16),
        ("slot_count", c_uint16),
    )


class Layout(ctypes.Structure):
    """`struct layout` in operations.h."""

    _fields_ = (
        ("nodes", POINTER(Node)),
        ("defaults", POINTER(Value)),
        ("closed", POINTER(ClosedEnum)),
        ("literals", c_void_p),
        ("slot_count", c_uint32),
        ("is_cdr", c_uint32),
    )


class Topic(ctypes.Structure):
    """`struct topic` in deliver.h."""

    _fields_ = (("publisher", c_void_p), ("wanted", c_void_p))


class Target(ctypes.Structure):
    """`struct target` in deliver.h."""

    _fields_ = (
        ("condition", Code),
        ("message", Code),
        ("limit", POINTER(Limit)),
        ("deferral", c_void_p),
        ("period", c_int64),
        ("topic", POINTER(Topic)),
        ("sender", c_void_p),
        ("board", POINTER(Board)),
        ("feeds", POINTER(Feed)),
        ("feed_count", c_uint32),
        ("trims", c_uint32),
        ("priority", c_uint32),
        ("id", c_uint32),
        ("waiting", c_uint32),
        ("filtered", c_uint32),
        ("collected", c_uint32),
        ("delivered", c_uint32),
        ("delivered_bytes", c_uint32),
        ("dropped", c_uint32 * len(LOSSES)),
    )


class Collect(ctypes.Structure):
    """`struct collect` in collect.h."""

    _fields_ = (
        ("collector", c_void_p),
        ("by", Code),
        ("count", Code),
        ("order", Code),
        ("senders", POINTER(c_uint32)),
        ("is_text", c_uint32),
        ("signs", c_uint32),
        ("items", c_uint16),
        ("counted", c_uint16),
        ("reserved", c_uint32),
    )


class Targets(ctypes.Structure):
    """`struct targets` in deliver.h."""

    _fields_ = (
        ("ttl", c_int64),
        ("layout", POINTER(Layout)),
        ("sources", POINTER(Value)),
        ("collect", POINTER(Collect)),
        ("targets", POINTER(Target)),
        ("count", c_uint32),
        ("route", c_uint32),
        ("topic", c_uint32),
        ("generation", c_uint32),
    )


class Route(ctypes.Structure):
    """`struct route` in carrier.h."""

    _fields_ = (
        ("sends", Targets),
        ("publishes", Targets),
        ("last_message", c_uint32),
        ("duration", c_uint32),
    )


class Entry(ctypes.Structure):
    """`struct entry` in carrier.h."""

    _fields_ = (("route", c_int32), ("received", c_uint32))


class Case(ctypes.Structure):
    """`struct payload_case` in carrier.h."""

    _fields_ = (("number", c_uint32), ("row", c_int32), ("is_ignored", c_uint32), ("unhandled", c_uint32))


class Peer(ctypes.Structure):
    """`struct peer` in carrier.h."""

    _fields_ = (
        ("address", c_uint32),
        ("port", c_uint32),
        ("column", c_uint32),
        ("last_seen", c_uint32),
        ("id", c_uint32),
    )


class Listener(ctypes.Structure):
    """`struct listener` in carrier.h."""

    _fields_ = (
        ("fd", c_int32),
        ("id", c_uint32),
        ("repairs", c_uint32),
        ("keeps_input", c_uint32),
        ("peers", POINTER(Peer)),
        ("entries", POINTER(Entry)),
        ("peer_count", c_uint32),
        ("columns", c_uint32),
        ("received", c_uint32),
        ("received_bytes", c_uint32),
        ("padded", c_uint32),
        ("rejected", c_uint32 * REASONS),
        ("reserved", c_uint32),
    )


class Program(ctypes.Structure):
    """`struct program` in carrier.h."""

    _fields_ = (
        ("generation", c_uint32),
        ("listener_count", c_uint32),
        ("case_count", c_uint32),
        ("unknown_case", c_uint32),
        ("schema", c_void_p),
        ("listeners", POINTER(Listener)),
        ("cases", POINTER(Case)),
        ("routes", POINTER(Route)),
    )


class Adoption(ctypes.Structure):
    """`struct adoption` in timers.h."""

    _fields_ = (("timer", c_void_p), ("to", c_void_p), ("target", c_void_p))


class TimerChange(ctypes.Structure):
    """`struct timer_change` in timers.h."""

    _fields_ = (
        ("adopted", POINTER(Adoption)),
        ("ended", POINTER(c_void_p)),
        ("adopted_count", c_uint32),
        ("ended_count", c_uint32),
    )


class Change(ctypes.Structure):
    """`struct change` in carrier.h."""

    _fields_ = (
        ("program", POINTER(Program)),
        ("replaced", POINTER(c_void_p)),
        ("timers", TimerChange),
        ("replaced_count", c_uint32),
        ("reserved", c_uint32),
    )


class PublishChange(ctypes.Structure):
    """`struct publish_change` in publish.h."""

    _fields_ = (("timers", TimerChange), ("next", c_void_p), ("generation", c_uint32), ("reserved", c_uint32))


class ForEach(ctypes.Structure):
    """`struct for_each` in from_ros.h."""

    _fields_ = (
        ("list", Code),
        ("stored", c_uint16),
        ("node", c_uint16),
        ("item", c_uint16),
        ("index", c_uint16),
        ("count", c_uint16),
        ("reserved", c_uint16 * 3),
    )


class RosRoute(ctypes.Structure):
    """`struct ros_route` in from_ros.h."""

    _fields_ = (
        ("targets", Targets),
        ("for_each", ForEach),
        ("seconds", c_uint16),
        ("nanoseconds", c_uint16),
        ("received", c_uint32),
        ("last_message", c_uint32),
        ("duration", c_uint32),
    )


class RosTopic(ctypes.Structure):
    """`struct ros_topic` in from_ros.h."""

    _fields_ = (
        ("subscription", c_void_p),
        ("routes", POINTER(RosRoute)),
        ("route_count", c_uint32),
        ("capacity", c_uint32),
        ("eventfd", c_int32),
        ("reserved", c_uint32),
    )


class RosSet(ctypes.Structure):
    """`struct ros_set` in from_ros.h."""

    _fields_ = (("topics", POINTER(RosTopic)), ("count", c_uint32), ("reserved", c_uint32))


class MessageRecord(ctypes.Structure):
    """`struct message_record` in carrier.h; the envelope follows."""

    _fields_ = (
        ("size", c_uint32),
        ("generation", c_uint32),
        ("to", POINTER(Targets)),
        ("received_at", c_int64),
        ("now", c_int64),
        ("oldest", c_int64),
        ("youngest", c_int64),
        ("column", c_uint32),
        ("is_single", c_uint32),
        ("length", c_uint32),
        ("start", c_uint32),
        ("payload_length", c_uint32),
        ("reserved", c_uint32),
    )


class Born(ctypes.Structure):
    """`struct born` in freshness.h."""

    _fields_ = (("oldest", c_int64), ("youngest", c_int64))


class Setting(ctypes.Structure):
    """`struct setting` in freshness.h."""

    _fields_ = (("offset", c_int64), ("since", c_int64), ("until", c_int64))


class Freshness(ctypes.Structure):
    """`struct freshness` in freshness.h."""

    _fields_ = (
        ("is_known", c_int64),
        ("offset", c_int64),
        ("since", c_int64),
        ("seen", c_int64),
        ("first", c_uint32),
        ("count", c_uint32),
        ("past", Setting * 32),
    )


class MirrorRecord(ctypes.Structure):
    """`struct mirror_record` in carrier.h; the datagram follows."""

    _fields_ = (
        ("size", c_uint32),
        ("listener", c_uint32),
        ("at", c_int64),
        ("address", c_uint32),
        ("port", c_uint32),
        ("length", c_uint32),
        ("reason", c_int32),
        ("endpoint", c_int32),
        ("reserved", c_uint32),
    )


__all__ = [
    "LOSSES",
    "NO_NAME",
    "REASONS",
    "Adoption",
    "Board",
    "BoardField",
    "BoardMessage",
    "Born",
    "Case",
    "Change",
    "ClosedEnum",
    "Code",
    "Collect",
    "DeadmanDestination",
    "Entry",
    "Feed",
    "ForEach",
    "Freshness",
    "Layout",
    "Limit",
    "Listener",
    "MessageRecord",
    "MirrorRecord",
    "Node",
    "NodeField",
    "Operation",
    "Peer",
    "Program",
    "PublishChange",
    "ReadOperation",
    "RosRoute",
    "RosSet",
    "RosTopic",
    "Route",
    "Schema",
    "Setting",
    "Target",
    "Targets",
    "TimerChange",
    "Topic",
    "Value",
    "WireField",
    "WireType",
]
