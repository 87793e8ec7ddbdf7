"""Reading of tables: YAML text to RouteTable, with all findings about text and shape."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from router import inputs
from router.errors import Diagnostic, Severity, TableError, plural
from router.table.addresses import BadAddressError, outside_findings, parse_local
from router.table.extends import load_chain
from router.table.nodes import MappingNode, ScalarNode

if TYPE_CHECKING:
    from router.table.addresses import Address
    from router.table.model import RouteTable
    from router.table.source import Source


def load_table(path: Path, environ: Mapping[str, str] | None = None) -> tuple[RouteTable | None, list[Diagnostic]]:
    """Read the table at `path`. Return it with its findings, in the order of the file.

    The table is None only if nothing usable could be built (unreadable, bad YAML, no envelope). Otherwise it contains
    all valid parts, and `broken` names the others. `environ` defaults to the environment.
    """
    from router.table.build import build_table
    from router.table.shape import check_shape
    from router.table.shorthand import written_out
    from router.table.yaml_errors import cut_findings

    sources: list[Source] = []
    findings: list[Diagnostic] = []
    table = None
    try:
        root = load_chain(path, inputs.ENVIRONMENT if environ is None else environ, sources, findings)
        shaped = written_out(check_shape(root, findings))
        table = build_table(shaped, sources, findings)
        findings.extend(cut_findings(shaped, sources))
        if table is not None and table.networks is not None:
            findings.extend(outside_findings(shaped, table.networks, [source.file for source in sources]))
    except TableError as error:
        findings.extend(error.diagnostics)
    return table, in_order(findings)


def read_table(path: Path) -> RouteTable:
    """Read the table at `path`. Raises TableError if it has errors."""
    table, findings = load_table(path)
    if table is None or any(finding.severity is Severity.ERROR for finding in findings):
        raise TableError(findings)
    return table


def http_address(path: Path, environ: Mapping[str, str]) -> Address | None:
    """Return the table's `http.address` without checking the rest; None if it is missing or invalid.

    `router status` needs nothing else.
    """
    try:
        http = load_chain(path, environ, [], []).get("http")
        written = http.get("address") if isinstance(http, MappingNode) else None
        if isinstance(written, ScalarNode) and isinstance(written.value, str) and not written.broken:
            return parse_local(written.value)
    except (TableError, BadAddressError):
        pass
    return None


def in_order(findings: Iterable[Diagnostic]) -> list[Diagnostic]:
    """Return each finding once, in the order of the files."""
    return sorted(dict.fromkeys(findings), key=lambda finding: (finding.span, finding.code.value, finding.message))


def summary(table: RouteTable) -> str:
    """Return `26 payload cases, 31 topics, 2 services, 8 endpoints, 1 gateway`; kinds without any are omitted."""
    topics = sum(len(route.all_topics) for route in table.routes)
    cases = {route.case.value for route in table.routes}
    counts = {
        "payload case": len(cases),
        "topic": topics,
        "service": len(table.services) + len(table.called),
        "endpoint": len(table.endpoints),
        "gateway": len(table.gateways),
    }
    named = [plural(count, noun) for noun, count in counts.items() if count]
    return ", ".join(named) or "nothing to do"
