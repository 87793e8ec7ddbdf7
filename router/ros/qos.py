"""QoS profiles for rclpy, the policies that the middleware applies, and which of them are incompatible."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any, NamedTuple

from rclpy.duration import Duration, Infinite
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from router.compiler.compiled_table import QosPlan
from router.ros.rcl import RCL


def qos_profile(plan: QosPlan) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy[plan.reliability.upper()],
        durability=DurabilityPolicy[plan.durability.upper()],
        history=HistoryPolicy[plan.history.upper()],
        depth=plan.depth,
        deadline=_duration(plan.deadline),
        lifespan=_duration(plan.lifespan),
        liveliness=LivelinessPolicy[plan.liveliness.upper()],
        liveliness_lease_duration=_duration(plan.liveliness_lease_duration),
    )


def _duration(nanoseconds: int | None) -> Duration:
    return Infinite if nanoseconds is None else Duration(nanoseconds=nanoseconds)


class ActualQos(NamedTuple):
    """The policies of an open publisher or subscription that decide which peers it matches. Times in ns."""

    reliability: int
    durability: int
    deadline: int
    liveliness: int
    lease: int


class _Time(ctypes.Structure):
    _fields_ = (("sec", ctypes.c_uint64), ("nsec", ctypes.c_uint64))

    def in_ns(self) -> int:
        return int(self.sec) * 1_000_000_000 + int(self.nsec)


class _Profile(ctypes.Structure):
    """The beginning of rmw_qos_profile_t."""

    _fields_ = (
        ("history", ctypes.c_int),
        ("depth", ctypes.c_size_t),
        ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int),
        ("deadline", _Time),
        ("lifespan", _Time),
        ("liveliness", ctypes.c_int),
        ("lease", _Time),
    )


for _actual_qos in (RCL.rcl_publisher_get_actual_qos, RCL.rcl_subscription_get_actual_qos):
    _actual_qos.argtypes, _actual_qos.restype = (ctypes.c_void_p,), ctypes.POINTER(_Profile)


def publisher_qos(pointer: int) -> ActualQos:
    """Return the policies in effect, with `system_default` and `best_available` resolved. `pointer`: of an open one."""
    return _named(RCL.rcl_publisher_get_actual_qos(pointer).contents)


def subscription_qos(pointer: int) -> ActualQos:
    """Like `publisher_qos`."""
    return _named(RCL.rcl_subscription_get_actual_qos(pointer).contents)


def _named(qos: Any) -> ActualQos:
    return ActualQos(qos.reliability, qos.durability, qos.deadline.in_ns(), qos.liveliness, qos.lease.in_ns())


def incompatible_policies(offered: ActualQos, requested: ActualQos) -> Iterator[str]:
    """Yield the QOS_POLICIES in which a publisher's offer does not meet a subscriber's request, as DDS defines it."""
    if (offered.reliability, requested.reliability) == (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
        yield "reliability"
    if (offered.durability, requested.durability) == (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL):
        yield "durability"
    if offered.deadline > requested.deadline:
        yield "deadline"
    automatic_for_manual = LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC
    if offered.lease > requested.lease or (offered.liveliness, requested.liveliness) == automatic_for_manual:
        yield "liveliness"
