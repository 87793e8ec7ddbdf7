"""What happens to a message: bytes in, calls out. Sockets, ROS, threads and clocks are handed in."""

from router.engine.delivery import Report
from router.engine.dispatch import InboundEngine, OutboundEngine, PartEngine
from router.engine.slow_path import MAX_DATAGRAM

__all__ = ["MAX_DATAGRAM", "InboundEngine", "OutboundEngine", "PartEngine", "Report"]
