"""Addresses of a table: text to Address, and which of them one machine can have.

Knows the schema's shape; who else has an address is the compiler's business.
"""

from __future__ import annotations

from router.errors import Code, Diagnostic, SourceSpan
from router.table.address import BadAddressError, parse_address
from router.table.model import Address, Located
from router.table.reading import UnsoundError


def remote_address(written: Located[str]) -> Located[Address]:
    """The address of one machine, to send to."""
    address = _address(written)
    if _first(address) == 0 or _first(address) >= 224:
        raise _bad_address(address.span, f"{address.value.host} is not the address of one machine")
    return address


def local_address(written: Located[str]) -> Located[Address]:
    """An address that this machine can have, or 0.0.0.0 for all that it has."""
    address = _address(written)
    if _first(address) >= 224:
        raise _bad_address(address.span, f"{address.value.host} is not an address that this machine can have")
    return address


def _first(address: Located[Address]) -> int:
    return int(address.value.host.partition(".")[0])


def _address(written: Located[str]) -> Located[Address]:
    try:
        return Located(parse_address(written.value), written.span)
    except BadAddressError as error:
        raise _bad_address(written.span, error.what, error.hint) from error


def _bad_address(span: SourceSpan, what: str, hint: str = "broadcast and multicast are not supported") -> UnsoundError:
    return UnsoundError(Diagnostic(span, Code.BAD_ADDRESS, what, hint))
