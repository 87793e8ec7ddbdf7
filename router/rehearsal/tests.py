"""Tests of route tables: found, read and run. The language is in docs/testing-tables.md."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from router.compiler.program import Program
from router.rehearsal.coverage import Coverage
from router.rehearsal.model import TableTestFile
from router.rehearsal.reading import ENDINGS
from router.rehearsal.running import Result, Runner


def find_test_files(paths: Sequence[Path]) -> list[Path]:
    """The files that the paths stand for, each once: a folder for those in it that are named as tests."""
    files: dict[Path, None] = {}
    for path in paths:
        if os.path.isdir(path):  # noqa: PTH112  (Path.is_dir raises where a folder above is not ours to read)
            found = sorted(file for file in path.iterdir() if file.name.endswith(ENDINGS) and file.name[0] != ".")
            files.update(dict.fromkeys(found))
        else:
            files[path] = None
    return list(files)


def prove(file: TableTestFile, only: str = "", coverage: Coverage | None = None) -> list[Result]:
    """Runs the tests of a file whose name contains `only`. `coverage`, of its table, learns what they touch."""
    program = file.checked.program if coverage is None else coverage.program
    assert isinstance(program, Program)  # noqa: S101 - a file whose table has none is not read
    runner = Runner(file, program, coverage.saw if coverage else lambda _: None)
    return [runner.run(test) for test in file.tests if only in test.name]
