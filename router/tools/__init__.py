"""What an operator runs beside the router: send, tap, sim, and the view of a running router's metrics."""

from __future__ import annotations

from router.errors import RouterError


class UsageError(RouterError):
    """What the operator asked for cannot be done; the message is one line that says what and why."""
