"""Parses requests strictly (RFC 9112): a request that a proxy could read as something else is rejected.

No request here has a body. One that announces a body ends its connection, so no body is read as a further request.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus

_LINE = re.compile(rb"([A-Z]+) ([!-~]+) HTTP/([0-9])\.([0-9])")
_TARGET = re.compile(rb"(?:https?://([^/?#@]+))?((?:/|(?<!^)(?=\?|$))[^?#]*)(?:\?([^#]*))?", re.IGNORECASE)
"""A path, or a whole URL (RFC 9112, 3.2.2), with a query."""
_FIELD = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):([\t -~\x80-\xff]*)")
_HOST = re.compile(r"[A-Za-z0-9._-]+(:[0-9]{1,5})?|\[[0-9A-Fa-f:.]+\](:[0-9]{1,5})?")


class BadRequestError(Exception):
    """A request that is rejected, after which the connection ends."""

    def __init__(self, text: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True, slots=True)
class Request:
    """`headers` have lower-case names. `host` is "" in an HTTP/1.0 request without a host."""

    method: str
    path: str
    query: str
    host: str
    headers: Mapping[str, Sequence[str]]
    is_last: bool

    def header(self, name: str, missing: str = "") -> str:
        return ", ".join(self.headers[name]) if name in self.headers else missing


def parse(head: bytes) -> Request:
    """Parse the lines of a request, with the empty line at their end. Raises BadRequestError."""
    first, *lines = head.removesuffix(b"\r\n\r\n").split(b"\r\n")
    if (line := _LINE.fullmatch(first)) is None:
        raise BadRequestError("the first line is not a request")
    method, target, major, minor = line.groups()
    if major != b"1":
        raise BadRequestError("only HTTP/1 is spoken here", HTTPStatus.HTTP_VERSION_NOT_SUPPORTED)
    if (found := _TARGET.fullmatch(target)) is None:
        raise BadRequestError("the target is neither a path nor a URL")
    authority, path, query = (part.decode() if part else "" for part in found.groups())
    headers = _headers(lines)
    hosts = headers.get("host", [])
    if len(hosts) > 1 or (not hosts and minor != b"0"):
        raise BadRequestError("a request needs one 'Host' header")
    if any(not _HOST.fullmatch(host) for host in (*hosts, *([authority] if authority else []))):
        raise BadRequestError("the host is not an address or name, with or without a port")
    if "transfer-encoding" in headers or headers.get("content-length", ["0"]) != ["0"]:
        raise BadRequestError("no request here has a body")
    options = {option.strip().lower() for value in headers.get("connection", ()) for option in value.split(",")}
    is_last = "close" in options or minor == b"0"
    return Request(method.decode(), path or "/", query, authority or "".join(hosts), headers, is_last)


def _headers(lines: Sequence[bytes]) -> Mapping[str, Sequence[str]]:
    headers: dict[str, list[str]] = {}
    for line in lines:
        if (field := _FIELD.fullmatch(line)) is None:  # also a folded line, a lone CR or LF, a space before the colon
            raise BadRequestError("a line is not 'NAME: VALUE'")
        headers.setdefault(field[1].decode().lower(), []).append(field[2].decode("latin-1").strip(" \t"))
    return headers
