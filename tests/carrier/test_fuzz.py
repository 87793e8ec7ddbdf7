"""Fuzzing of the carrier's C code under sanitizers, and against Python."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from benchmarks.fuzz_carrier import fuzz
from tests.carrier.decisions import SCHEMAS
from tests.carrier.fuzz import build_machine
from tests.carrier.fuzz.build import TARGETS, build


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("clang") is None, reason="needs clang")
@pytest.mark.parametrize("target", TARGETS)
def test_a_minute_of_libfuzzer(target: str, tmp_path: Path) -> None:
    fuzz_for_a_minute(build(tmp_path, target), tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("clang") is None, reason="needs clang")
def test_a_minute_of_libfuzzer_on_programs(tmp_path: Path) -> None:
    fuzz_for_a_minute(build_machine.build(tmp_path), tmp_path)


def fuzz_for_a_minute(program: Path, folder: Path) -> None:
    command = [str(program), "-max_total_time=60", "-max_len=400", "-verbosity=0", f"-artifact_prefix={folder}/"]
    result = subprocess.run([*command, str(folder / "corpus")], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("schema", SCHEMAS)
def test_a_hundred_thousand_datagrams_against_python(schema: str) -> None:
    differences: list[str] = []
    fuzz(schema, 100_000, 2, differences.append)
    assert not differences
