"""What happens to a message: bytes in, calls out. Sockets, ROS, threads and clocks are handed in."""

from router.compiler.metrics import Report
from router.engine.dispatch import InboundEngine, OutboundEngine, PartEngine

__all__ = ["InboundEngine", "OutboundEngine", "PartEngine", "Report"]
