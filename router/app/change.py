"""The adoption of a program, and what takes part in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from router.carrier.loading import LoadedImage
from router.carrier.ros_routes import RosRoutes
from router.compiler.program import Program

if TYPE_CHECKING:
    from router.app.sockets import SocketChange
    from router.gateway.thread import GatewayChange
    from router.ros.endpoints import RosChange


@dataclass(slots=True)
class Change:
    """A program that is being adopted, with what each participant has prepared for it.

    `before` is the image that it replaces: that of the running program or of a head start, None without either.
    `is_first` if no program runs yet.
    """

    program: Program
    before: LoadedImage | None
    is_first: bool
    sockets: SocketChange | None = None
    image: LoadedImage | None = None
    ros: RosChange | None = None
    routes: RosRoutes | None = None
    gateways: GatewayChange | None = None


class Participant(Protocol):
    """Takes part in an adoption, in these steps. Only `prepare` may fail, and `adopt` where the table says so."""

    def prepare(self, change: Change) -> None:
        """Open what the program needs in addition. Raises StartError with nothing changed."""

    def undo(self, change: Change) -> None:
        """Close what `prepare` has opened; it was called before, but may have failed for others."""

    def adopt(self, change: Change) -> None:
        """Change to the program."""

    def finish(self, change: Change) -> None:
        """Close what only the earlier program used, once no thread uses it."""
