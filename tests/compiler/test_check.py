"""The check of a table as a whole."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import pytest

from router.carrier.image import image_of
from router.carrier.library import library
from router.compiler import check, check_table
from tests.tables import ROUTES


def test_no_garbage_is_collected_while_a_table_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    enabled: list[bool] = []

    def noted(_: object) -> list[Any]:
        enabled.append(gc.isenabled())
        return []

    monkeypatch.setattr(check, "check_gateways", noted)
    check_table(ROUTES / "rover.yaml", {})
    assert (enabled, gc.isenabled()) == ([False], True)


def test_collection_goes_on_after_a_mistake_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "load_table", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        check_table(ROUTES / "rover.yaml", {})
    assert gc.isenabled()


@pytest.mark.parametrize("name", ["rover", "sim", "legacy"])
def test_every_process_makes_the_same_program(name: str) -> None:
    """Also the same image of it, byte for byte. The order of sets differs among processes."""
    made = [
        subprocess.run(
            [sys.executable, "-m", __name__, ROUTES / f"{name}.yaml"],
            env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert len(made[0]) > 10_000
    assert made[0] == made[1]


def plain(value: Any) -> Any:
    """What a part of a program consists of: the order of a set alone does not count."""
    if isinstance(value, (set, frozenset)):
        return sorted(map(repr, value))
    if isinstance(value, dict):
        return [(key, plain(part)) for key, part in value.items()]
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *(plain(getattr(value, each.name)) for each in fields(value))]
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if value is None or isinstance(value, (bool, int, float, str, bytes, Enum, Path)):
        return value
    return type(value).__name__


if __name__ == "__main__":
    checked = check_table(Path(sys.argv[1]), {})
    program = checked.program
    assert program is not None
    print(
        plain([checked.diagnostics, [*program.counters.series()], program.lowered, program.inbound, program.outbound])
    )
    print(plain([program.senders, program.publishers, program.subscriptions, program.deadmen, program.boards]))
    print(*image_of(library(), program))
