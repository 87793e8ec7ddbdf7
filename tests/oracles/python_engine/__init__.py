"""What happens to a message: bytes in, calls out. Sockets, ROS, threads and clocks are handed in."""

from router.compiler.metrics import Report
from tests.oracles.python_engine.dispatch import InboundEngine, OutboundEngine

__all__ = ["InboundEngine", "OutboundEngine", "Report"]
