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


@pytest.mark.slow
def test_the_tests_of_this_folder_pass_with_sanitizers() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", str(FOLDER)]
    environment = {**os.environ, **sanitizer_variables(), SANITIZED: "1", "PYTHONPATH": str(FOLDER.parents[1])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
