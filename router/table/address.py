"""`192.168.0.30:8`: an IPv4 literal and a port, read strictly.

Knows text only. Names are never looked up: a table means the same on every machine.
"""

from __future__ import annotations

import re

from router.table.model import Address

_EXAMPLE = "write an IPv4 address and a port, such as 192.168.0.30:8"
_NUMBERS = re.compile(r"[0-9]+(?:\.[0-9]+)*")

LOCATOR = re.compile(r"(?P<protocol>[a-z]+/)(?P<address>[^?#]*)(?P<rest>(?:[?#].*)?)")
"""Zenoh's: tcp/192.168.0.10:7447. What may follow the address is no address of another machine."""


class BadAddressError(ValueError):
    """Why a text is no address, and what to do about it."""

    def __init__(self, what: str, hint: str = _EXAMPLE) -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint


def parse_address(text: str) -> Address:
    """The address that the text names. Raises BadAddressError."""
    host, colon, port = text.rpartition(":")
    if not colon or _is_ipv4(port):
        raise BadAddressError(f"'{text}' has no port")
    if not host:
        raise BadAddressError(f"'{text}' has no IP address")
    if ":" in host:
        raise BadAddressError(f"'{host}' is not an IPv4 address")
    if not _is_ipv4(host):
        raise _bad_host(host)
    if not re.fullmatch("[0-9]{1,5}", port) or not 1 <= int(port) <= 65535 or port[0] == "0":
        raise BadAddressError(f"the port '{port}' is not a number from 1 to 65535")
    return Address(host, int(port))


def _is_ipv4(text: str) -> bool:
    parts = text.split(".")
    return len(parts) == 4 and all(map(_is_octet, parts))


def _is_octet(text: str) -> bool:
    return re.fullmatch("[0-9]{1,3}", text) is not None and int(text) <= 255 and str(int(text)) == text


def _bad_host(host: str) -> BadAddressError:
    if not _NUMBERS.fullmatch(host):
        hint = "addresses are IPv4 literals such as 192.168.0.30; names are not looked up"
        return BadAddressError(f"'{host}' is not an IPv4 address", hint)
    parts = host.split(".")
    if len(parts) != 4:
        return BadAddressError(f"'{host}' has {len(parts)} numbers where an IPv4 address has four")
    wrong = next(part for part in parts if not _is_octet(part))
    return BadAddressError(f"'{wrong}' in '{host}' is not a number from 0 to 255, written without leading zeros")
