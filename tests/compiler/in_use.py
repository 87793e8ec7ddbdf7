"""What the rover's table uses, read when tests are collected: each gets a test of its own."""

from __future__ import annotations

from router.compiler import check_table
from tests.tables import ROUTES

_ROUTES = check_table(ROUTES / "rover.yaml", {}).routes

INBOUND_CASES = [checked.case.name for checked in _ROUTES if not checked.route.is_outbound and not checked.route.ignore]
ROS_TYPES = sorted({target.type.name for checked in _ROUTES for target in checked.targets if target.type})
