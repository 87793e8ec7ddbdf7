"""Python packages that only some tables need. The extras of `rover-router` in pyproject.toml have them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec

from router.assets import asset, is_installed
from router.errors import ConfigurationError, listed
from router.table.model import RouteTable

EXTRAS: Mapping[str, Sequence[str]] = {
    "gateways": ("backports.zstd", "msgspec", "orjson", "websockets", "zenoh"),
    "recording": ("mcap", "zstandard"),
    "foxglove": ("mcap", "websockets"),
}
"""The modules of each extra; of those that are in two, the first is the more likely one."""


def missing_extras(table: RouteTable) -> Iterator[ConfigurationError]:
    """Yield an error for each extra that the table needs and that is not, or not wholly, installed."""
    users = {
        "gateways": ("a gateway", next((gateway.span for gateway in table.gateways.values()), None)),
        "recording": ("'record'", table.record.span if table.record else None),
        "foxglove": ("'foxglove'", table.foxglove.span if table.foxglove else None),
    }
    for extra, (user, span) in users.items():
        if span is not None and (missing := missing_modules(extra)):
            what = f"{user} needs Python packages that are not installed: {listed(missing)}"
            yield missing_extra(f"{span}: {what}", extra)


def missing_modules(extra: str) -> list[str]:
    return [name for name in EXTRAS[extra] if not _is_installed(name)]


def missing_extra(what: str, extra: str) -> ConfigurationError:
    """Return the error that an extra is missing, with the remedy."""
    package = f"`pip install 'rover-router[{extra}]'`"
    return ConfigurationError(what, f"run {package if is_installed(asset('schemas')) else 'make setup'}")


def extra_of(module: str) -> str | None:
    """Return the extra that a module belongs to; None if each installation has it."""
    top = module.partition(".")[0]
    return next((extra for extra, names in EXTRAS.items() if top in {name.partition(".")[0] for name in names}), None)


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # the package that contains it
        return False
