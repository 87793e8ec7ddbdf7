"""Opens single objects of the carrier as an image lists them, and images without sockets."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any

from router.carrier.deadmen import NativeDeadman, open_deadman
from router.compiler.compiled_table import DeadmanPlan
from router.compiler.metrics import Counters
from router.image.names import Names
from router.image.openings import deadman_arguments

GROUP = ("group",)


def opened_deadman(
    library: ctypes.CDLL,
    group: int,
    plan: DeadmanPlan,
    counters: Counters,
    names: Names,
    outlets: Mapping[str, Any],
    kind: str = "sender",
) -> NativeDeadman:
    """A deadman that sends through the senders or publishers (`kind`) of `outlets`, by name."""

    def address(value: Any) -> Any:
        return group if value is GROUP else outlets[value].address

    endpoints = [name for name, _ in plan.datagrams]
    arguments = GROUP, *deadman_arguments(plan, counters, names, kind, lambda _, name: name)
    return open_deadman(library, arguments, address, endpoints, [outlets[name] for name in endpoints])
