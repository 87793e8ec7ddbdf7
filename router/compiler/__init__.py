"""What a route table means: RouteTable and types in, findings or a Program out.

Knows no socket, no rclpy and no clock.
"""

from __future__ import annotations

from router.compiler.check import Checked, check_table
from router.compiler.program import STRANGER, source_label

__all__ = ["check_table", "Checked", "STRANGER", "source_label"]
