"""Delayed imports."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from router.lazy_import import lazy_import


@pytest.fixture(autouse=True)
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`large`, and `user`, which imports it."""
    (tmp_path / "large.py").write_text("SIZE = 7\n")
    (tmp_path / "user.py").write_text("import large\ndef size():\n    return large.SIZE\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("large", "user"):
        monkeypatch.delitem(sys.modules, name, raising=False)


def test_a_module_is_imported_when_it_is_first_used() -> None:
    with lazy_import("large"):
        user = importlib.import_module("user")
    assert "large" not in sys.modules
    assert user.size() == 7
    assert sys.modules["large"].SIZE == 7


def test_it_can_be_used_while_its_import_is_delayed() -> None:
    with lazy_import("large"):
        assert importlib.import_module("user").size() == 7
        real = sys.modules["large"]
        assert "SIZE" in vars(real)
    assert sys.modules["large"] is real


def test_others_get_the_module_itself() -> None:
    with lazy_import("large"):
        importlib.import_module("user")
    assert vars(importlib.import_module("large"))["SIZE"] == 7


def test_what_is_missing_says_so_when_it_is_used() -> None:
    with lazy_import("larger"):
        larger = importlib.import_module("larger")
    with pytest.raises(ModuleNotFoundError, match="larger"):
        _ = larger.SIZE


def test_what_has_been_imported_stays() -> None:
    large = importlib.import_module("large")
    with lazy_import("large"):
        assert importlib.import_module("large") is large
    assert sys.modules["large"] is large
