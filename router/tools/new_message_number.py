"""Which number a new payload case can have: one that never was another's, since boards in the field remember."""

from __future__ import annotations

import re

from router.errors import UsageError
from router.tools.new_message_model import Site
from router.types.lock_file import read_lock

LARGEST_NUMBER = (1 << 29) - 1
_OF_PROTOBUF = range(19_000, 20_000)


def check_number(number: int, case: str, site: Site) -> None:
    """Raises UsageError, with the next free number."""
    lock, envelope = read_lock(site.schema.lock), site.envelope.name
    entries = lock.messages[envelope].entries if lock is not None and envelope in lock.messages else frozenset()
    holders = {entry.number: entry.name for entry in entries}
    holders |= {field.number: field.name for field in site.schema.messages[envelope].fields}
    above = range(max(holders, default=0) + 1, LARGEST_NUMBER)
    free = next(candidate for candidate in above if _is_free(candidate, site))
    if not 1 <= number <= LARGEST_NUMBER or number in _OF_PROTOBUF:
        raise UsageError(f"{number} is no field number of protobuf; {free} is free")
    if number in holders:
        raise UsageError(f"number {number} belongs to '{holders[number]}', for ever; {free} is free")
    if any(number in span for span in site.schema.reserved_numbers(envelope)):
        raise UsageError(f"{envelope} reserves number {number}; {free} is free")
    if promised := _promise(number, site):
        raise UsageError(f"{site.file(envelope)} says: {promised} {free} is free")
    if case in holders.values():
        was = next(old for old, name in holders.items() if name == case)
        raise UsageError(f"'{case}' had number {was} once, and cannot come back with another; take another name")


def _is_free(number: int, site: Site) -> bool:
    reserved = any(number in span for span in site.schema.reserved_numbers(site.envelope.name))
    return not reserved and number not in _OF_PROTOBUF and not _promise(number, site)


def _promise(number: int, site: Site) -> str:
    """The comment of the envelope's file that speaks of the number, such as `Number 30 is promised to ...`."""
    text = (site.schema.root / site.file(site.envelope.name)).read_text(encoding="utf-8")
    found = re.search(rf"//\s*(.*\b[Nn]umber {number}\b.*)", text)
    return found[1] if found else ""
