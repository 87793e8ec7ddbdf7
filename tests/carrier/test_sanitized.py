"""The tests of the carrier, on a library that finds what C forgives."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.carrier.building import sanitizer_variables
from tests.carrier.conftest import SANITIZED

FOLDER = Path(__file__).parent
FILES = sorted(str(path) for path in FOLDER.glob("test_*.py"))
SHARES = 4
"""All files at once would take longer than a test may."""


@pytest.mark.slow
@pytest.mark.parametrize("share", range(SHARES))
def test_the_tests_of_this_folder_pass_with_sanitizers(share: int) -> None:
    files = FILES[share::SHARES]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *files]
    variables = {SANITIZED: "1", "HYPOTHESIS_PROFILE": "quick", "PYTHONPATH": str(FOLDER.parents[1])}
    environment = {**os.environ, **sanitizer_variables(), **variables}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
