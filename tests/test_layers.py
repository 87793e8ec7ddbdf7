"""Imports go down the list of layers only, and the outside world is touched at the edges alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROUTER = Path(__file__).parents[1] / "router"
LAYERS = ("errors", "assets", "table", "types", "compiler", "engine", "edges", "gateway", "tools", "runtime", "cli")
"""From the bottom up. `assets`, where our own files lie, knows nothing of the rest, as errors does."""
MODULES = sorted(ROUTER.rglob("*.py"))

CONFINED = {
    "rclpy": ("ros/node_and_publishers.py", "edges/ros_"),
    "socket": ("edges/", "tools/"),
}


def imported(path: Path) -> Iterator[str]:
    """Full names of the modules that a module imports, anywhere in it, for types as well."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names if node.module == "router")


def layer(path: Path) -> str | None:
    """`router/__init__.py` and `router/__main__.py`, which are no layer, have none."""
    part = path.relative_to(ROUTER).parts[0].removesuffix(".py")
    return None if part.startswith("__") else part


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROUTER)))
def test_module_imports_no_layer_above_its_own(path: Path) -> None:
    own = layer(path)
    if own is None:
        return
    used = {name.split(".")[1] for name in imported(path) if name.startswith("router.")}
    above = {name for name in used if LAYERS.index(name) > LAYERS.index(own)}
    assert not above, f"{own} is below {', '.join(sorted(above))}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROUTER)))
def test_the_outside_world_is_imported_at_the_edges_alone(path: Path) -> None:
    relative = path.relative_to(ROUTER).as_posix()
    roots = {name.partition(".")[0] for name in imported(path)}
    for module, places in CONFINED.items():
        if module in roots:
            assert relative.startswith(places), f"{relative} imports {module}"


def test_every_module_says_what_it_is_for() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in MODULES}
    assert [path for path, text in texts.items() if text.strip() and not ast.get_docstring(ast.parse(text))] == []
