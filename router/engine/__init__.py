"""What happens to a message: bytes in, calls out. Knows no socket, no rclpy, no thread and no clock of its own."""

from router.engine.dispatch import MAX_DATAGRAM, Engine
from router.engine.outbound import OutboundEngine
from router.engine.outcome import Report

__all__ = ["MAX_DATAGRAM", "Engine", "OutboundEngine", "Report"]
