"""Which package may import which, and which may use sockets, threads and ROS."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROUTER = Path(__file__).parents[1] / "router"

GROUND = "declared errors shortage inputs assets hosts lazy_import clock log threads"
LANGUAGE = "declared errors shortage inputs assets hosts lazy_import library table types compiler"
IMPORTS = {
    "declared": "",
    "errors": "",
    "shortage": "",
    "inputs": "errors shortage",
    "assets": "",
    "hosts": "",
    "clock": "",
    "lazy_import": "",
    "library": "declared errors shortage assets",
    "log": "clock errors lazy_import shortage",
    "threads": "clock log shortage",
    "table": "errors hosts inputs assets lazy_import",
    "types": "declared errors inputs assets lazy_import",
    "values": "errors types",
    "compiler": "declared errors hosts inputs assets lazy_import library table types",
    "datagrams": "declared errors table types",
    "image": LANGUAGE,
    "net": f"{GROUND} {LANGUAGE} datagrams",
    "carrier": f"{GROUND} {LANGUAGE} datagrams image net",
    "startup_image": f"{GROUND} {LANGUAGE} datagrams image net carrier",
    "ros": f"{GROUND} {LANGUAGE}",
    "gateway": f"{GROUND} {LANGUAGE} datagrams image net carrier ros",
    "services": LANGUAGE,
    "recording": f"{GROUND} {LANGUAGE} datagrams net",
    "observe": f"{GROUND} {LANGUAGE} values datagrams net recording",
    "rehearsal": f"{LANGUAGE} values datagrams image carrier recording services",
    "tools": f"{GROUND} {LANGUAGE} values datagrams image net carrier ros gateway recording observe rehearsal services",
    "app": f"{GROUND} {LANGUAGE} values datagrams image net carrier startup_image ros gateway recording observe"
    " services",
    "cli": f"{GROUND} {LANGUAGE} values datagrams net ros gateway recording observe rehearsal tools image carrier"
    " startup_image app services",
}
"""Package -> the packages that it may import. `docs/architecture.md` shows the same."""

PURE = {"declared", "errors", "hosts", "lazy_import", "library", "table", "types", "values", "compiler", "datagrams"}
PURE |= {"image", "services"}
IMPURE_MODULES = {"socket", "threading", "asyncio", "rclpy"}


@cache
def modules() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(ROUTER.rglob("*.py"))}


def imports(tree: ast.Module) -> Iterator[tuple[str, str | None, int]]:
    """All imports of a module, including imports for type checking: (module, name or None, line)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            yield from ((node.module, alias.name, node.lineno) for alias in node.names)


def package(path: Path) -> str | None:
    """The package of a module, or None for `router/__init__.py` and `router/__main__.py`."""
    part = path.relative_to(ROUTER).parts[0].removesuffix(".py")
    return None if part.startswith("__") else part


def imported_package(module: str, name: str | None) -> str | None:
    parts = [*module.split("."), name or ""]
    return parts[1] if parts[0] == "router" and parts[1] in IMPORTS else None


def where(path: Path, line: int) -> str:
    return f"{path.relative_to(ROUTER.parent)}:{line}"


def test_the_table_has_every_package_and_no_circle() -> None:
    assert {package(path) for path in modules()} - {None} == set(IMPORTS)
    list(TopologicalSorter({name: allowed.split() for name, allowed in IMPORTS.items()}).static_order())


def test_packages_import_what_the_table_allows() -> None:
    wrong = [
        f"{where(path, line)}: {own} imports {other}"
        for path, tree in modules().items()
        if (own := package(path)) is not None
        for module, name, line in imports(tree)
        if (other := imported_package(module, name)) not in {None, own, *IMPORTS[own].split()}
    ]
    assert wrong == []


def test_no_module_imports_the_tests() -> None:
    wrong = [
        where(path, line)
        for path, tree in modules().items()
        for module, _, line in imports(tree)
        if module.partition(".")[0] == "tests"
    ]
    assert wrong == []


def test_pure_packages_touch_no_socket_thread_loop_or_ros() -> None:
    wrong = [
        f"{where(path, line)}: imports {module}"
        for path, tree in modules().items()
        if package(path) in PURE
        for module, _, line in imports(tree)
        if module.partition(".")[0] in IMPURE_MODULES
    ]
    assert wrong == []


def test_rclpy_is_imported_in_ros_alone() -> None:
    wrong = [
        where(path, line)
        for path, tree in modules().items()
        if package(path) != "ros"
        for module, _, line in imports(tree)
        if module.partition(".")[0] == "rclpy"
    ]
    assert wrong == []


def test_no_module_imports_private_names_of_another_package() -> None:
    wrong = [
        f"{where(path, line)}: {module}.{name}"
        for path, tree in modules().items()
        for module, name, line in imports(tree)
        if imported_package(module, name) not in {None, package(path)}
        and any(part.startswith("_") for part in [*module.split("."), name or ""])
    ]
    assert wrong == []


def test_every_module_has_a_docstring() -> None:
    assert [str(path) for path, tree in modules().items() if tree.body and not ast.get_docstring(tree)] == []
