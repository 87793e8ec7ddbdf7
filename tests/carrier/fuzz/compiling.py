"""Compiles fuzz targets: for libFuzzer, or to a program that prints what becomes of each input of a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from router.carrier.build import NATIVE, compile_c

HERE = Path(__file__).parent

Compile = Callable[[Sequence[Path], Path], None]
"""Makes a program of sources. Headers that were made for it are beside it."""


def for_libfuzzer(files: Sequence[Path], program: Path) -> None:
    """With sanitizers. Raises BuildError, also without clang."""
    flags = ["-O2", "-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]
    _compile(flags, files, program, "clang")


def for_corpus(files: Sequence[Path], program: Path, compiler: str | None = None) -> None:
    """The program takes the folder with the inputs as its argument. Raises BuildError."""
    _compile(["-O2", "-DPRINTS_OUTCOMES"], [HERE / "corpus.c", *files], program, compiler)


def _compile(flags: Sequence[str], files: Sequence[Path], program: Path, compiler: str | None) -> None:
    compile_c([*flags, f"-I{NATIVE}", f"-I{program.parent}", *map(str, files), "-o", str(program)], compiler)
