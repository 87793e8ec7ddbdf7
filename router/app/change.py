"""The adoption of a program, as its participants (`runtime.py`) see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.carrier.loading import LoadedImage
from router.carrier.ros_routes import RosRoutes
from router.compiler.compiled_table import CompiledTable

if TYPE_CHECKING:
    from router.app.services import ServiceChange
    from router.app.sockets import SocketChange
    from router.gateway.thread import GatewayChange
    from router.ros.endpoints import RosChange


@dataclass(slots=True)
class Change:
    """A program that is being adopted, with what each participant has prepared for it.

    `before` is the image that it replaces: that of the running program or of a head start, None without either.
    `is_first` if no program runs yet; `is_same`: the image of the head start is equal, None without one. `opens_node`
    and `starts_gateways`: neither is there without this change.
    """

    program: CompiledTable
    before: LoadedImage | None
    is_first: bool
    is_same: bool | None = None
    sockets: SocketChange | None = None
    image: LoadedImage | None = None
    ros: RosChange | None = None
    routes: RosRoutes | None = None
    gateways: GatewayChange | None = None
    services: ServiceChange | None = None
    opens_node: bool = False
    starts_gateways: bool = False
