"""What happens to a message: bytes in, calls out. Knows no socket, no rclpy, no thread and no clock of its own."""

from router.engine.dispatch import Engine
from router.engine.outbound import OutboundEngine
from router.engine.outcome import Report
from router.engine.settling import MAX_DATAGRAM

__all__ = ["MAX_DATAGRAM", "Engine", "OutboundEngine", "Report"]
