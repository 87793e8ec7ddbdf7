"""What a gateway's websocket port says to a browser: one page, and which pages may open a websocket."""

from __future__ import annotations

import re
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from router.assets import page_policy

_HOST = re.compile(r"[A-Za-z0-9.:\[\]-]+")
_LOCAL = re.compile(r"([0-9.]+|\[[0-9a-f:]+\]|[a-z0-9-]+|[a-z0-9.-]+\.(local|lan|internal|home\.arpa))(:[0-9]+)?")
"""Addresses, and names that nobody can register for the whole internet."""


class Page:
    """HTML that needs nothing from outside, and is let nothing."""

    def __init__(self, html: bytes) -> None:
        self._html = html
        self._policy = page_policy(html)

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """What is answered to a request; None goes on to a websocket."""
        if any(value.lower() == "websocket" for value in request.headers.get_all("Upgrade")):
            if _is_from_elsewhere(request.headers):
                return connection.respond(
                    HTTPStatus.FORBIDDEN,
                    "a page of another host may not connect; open the page by this computer's address\n",
                )
            return None
        if request.path.partition("?")[0] != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "there is one page: /\n")
        return Response(HTTPStatus.OK, "OK", self._headers(request.headers), self._html)

    def _headers(self, asked: Headers) -> Headers:
        host = _HOST.fullmatch("".join(asked.get_all("Host")))
        # Older browsers do not take websockets of the same host for 'self'.
        sockets = f" ws://{host.group()} wss://{host.group()}" if host else ""
        return Headers(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Length": str(len(self._html)),
                "Cache-Control": "no-store",
                "Content-Security-Policy": f"{self._policy}; connect-src 'self'{sockets}",
                "X-Content-Type-Options": "nosniff",
                "Connection": "close",
            }
        )


def _is_from_elsewhere(headers: Headers) -> bool:
    """Whether a browser says that a page of another host wants this: any page that is open there could publish.

    A name that anybody can register may have been made to lead here after its page was loaded (DNS rebinding).
    """
    hosts = [host.lower() for host in headers.get_all("Host")]
    origins = [origin.lower().partition("://")[2] for origin in headers.get_all("Origin")]
    return any([origin] != hosts or not _LOCAL.fullmatch(origin) for origin in origins)
