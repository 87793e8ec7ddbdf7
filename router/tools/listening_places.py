"""What to listen to, as typed: `[udp://][HOST:]PORT`, `tcp://HOST:PORT`, `ws://HOST:PORT`, `zenoh://KEY?connect=...`;
and which topics, by globs as gateways have them.

Opens nothing but what was named. A transport's library is imported when it is needed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from urllib.parse import parse_qs

from router.compiler.selection import matcher, pattern_problem
from router.errors import Located, SourceSpan, UsageError, did_you_mean
from router.table.addresses import Address
from router.table.model import GatewayFormat, TopicPattern, ZenohSettings
from router.tools import places
from router.tools.listening import Source

_FORMS = "[udp://][HOST:]PORT, tcp://HOST:PORT, ws://HOST:PORT or zenoh://KEY?connect=LOCATOR"
_COMMAND_LINE = SourceSpan("command line", 1, 1)

Say = Callable[[str], None]


def open_source(text: str, form: GatewayFormat | None, gateway: Address | None, say: Say) -> Source:
    """`form` is of tcp alone, `gateway` (to ask for schemas) of udp. Raises UsageError and TransportError."""
    scheme, colon, rest = text.rpartition("://")
    scheme = scheme if colon else "udp"
    if form is not None and scheme != "tcp":
        raise UsageError("--format belongs to tcp://; elsewhere what arrives tells")
    if gateway is not None and scheme != "udp":
        raise UsageError("--ask belongs to udp; elsewhere schemas come unasked")
    match scheme:
        case "udp":
            from router.tools.listening_udp import UdpSource

            return UdpSource(_local(rest), gateway, say)
        case "tcp":
            from router.tools.listening_tcp import TcpSource

            return TcpSource(remote(rest), form, say)
        case "ws":
            from router.tools.listening_websocket import WebsocketSource

            return WebsocketSource(remote(rest.removesuffix("/")), say)
        case "zenoh":
            from router.tools.listening_zenoh import ZenohSource

            return ZenohSource(_zenoh(rest), say)
    raise UsageError(f"'{text}' is not {_FORMS}")


def remote(text: str) -> Address:
    """`HOST:PORT`. Raises UsageError."""
    if not re.fullmatch(r".+:[0-9]+", text):
        raise UsageError(f"'{text}' is not HOST:PORT")
    return places.destination(text, None)


def _local(text: str) -> Address:
    if not re.fullmatch(r"(?:.+:)?[0-9]+", text):
        raise UsageError(f"'{text}' is not {_FORMS}")
    return places.listening(text, None)


def _zenoh(text: str) -> ZenohSettings:
    """`rovers/loki_1?mode=client&connect=tcp/10.0.0.1:7447`; several `connect` and `listen` are possible."""
    key, _, query = text.partition("?")
    options = parse_qs(query, keep_blank_values=True)
    known = ("mode", "connect", "listen")
    if unknown := [name for name in options if name not in known]:
        raise UsageError(f"zenoh has no option '{unknown[0]}'; {did_you_mean(unknown[0], known)}")
    return ZenohSettings(
        key=Located(key, _COMMAND_LINE),
        mode=options.get("mode", ["peer"])[-1],
        connect=tuple(options.get("connect", ())),
        listen=tuple(options.get("listen", ())),
    )


def topic_filter(globs: Sequence[str]) -> Callable[[str], bool]:
    """Whether any of them matches a topic; without globs each topic does. Raises UsageError."""
    patterns = [TopicPattern(glob, is_regex=False, span=_COMMAND_LINE) for glob in globs]
    for problem in filter(None, map(pattern_problem, patterns)):
        raise UsageError(f"--topic: {problem.what}; {problem.hint}")
    matchers = [matcher(pattern) for pattern in patterns]
    return lambda topic: not matchers or any(matches(topic) for matches in matchers)
