"""Builds of the carrier for tests: with sanitizers, and programs in C that drive it."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

from router.carrier.build import NATIVE, build, compile_c, sources

MEMORY = "address,undefined"
RACES = "thread"


def sanitizing(sanitizers: str) -> list[str]:
    """Compiler flags. The first thing that a sanitizer finds ends the process."""
    return [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-g", "-O1"]


def sanitized_library(output: Path) -> Path:
    """The library with AddressSanitizer and UndefinedBehaviorSanitizer, for processes with `sanitizer_variables`."""
    return build(output, sanitizing(MEMORY), "gcc")


def sanitizer_variables() -> dict[str, str]:
    """The environment of a Python that loads `sanitized_library`: Python itself leaks on purpose."""
    command = ["/usr/bin/env", "gcc", "-print-file-name=libasan.so"]
    runtime = subprocess.check_output(command, text=True).strip()
    return {"LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0", "UBSAN_OPTIONS": "print_stacktrace=1"}


def program(output: Path, main: Path, flags: Sequence[str], compiler: str | None = None) -> Path:
    """A program of `main` and all sources of the carrier. Raises BuildError."""
    compile_c([str(main), *map(str, sources()), f"-I{NATIVE}", *flags, "-o", str(output)], compiler)
    return output
