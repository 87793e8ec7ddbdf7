"""Fuzzing of the carrier's C code under sanitizers."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from tests.carrier.fuzz import build_machine
from tests.carrier.fuzz.build import TARGETS, build

BUILDS: Mapping[str, Callable[[Path], Path]] = {
    **{name: partial(build, name=name) for name in TARGETS},
    "machine_fuzz": build_machine.build,
}


PAIRS = [[*BUILDS][at : at + 2] for at in range(0, len(BUILDS), 2)]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("clang") is None, reason="needs clang")
@pytest.mark.parametrize("names", PAIRS, ids=" and ".join)
def test_half_a_minute_of_libfuzzer_finds_nothing(tmp_path: Path, names: list[str]) -> None:
    """Two at a time: when these run, the other tests have ended, and a test of each would use one processor."""
    with ThreadPoolExecutor(2) as pool:
        found = dict(zip(names, pool.map(lambda name: fuzz(name, tmp_path / name), names), strict=True))
    assert not any(found.values()), found


def fuzz(name: str, folder: Path) -> str:
    """Return what libFuzzer says if it has found something, else nothing."""
    program = BUILDS[name](folder)
    command = [str(program), "-max_total_time=30", "-max_len=400", "-verbosity=0", f"-artifact_prefix={folder}/"]
    result = subprocess.run([*command, str(folder / "corpus")], capture_output=True, text=True, check=False)
    return result.stderr if result.returncode else ""
