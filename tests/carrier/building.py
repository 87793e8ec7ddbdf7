"""Builds of the carrier for tests: with sanitizers, and programs in C that drive it."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from ctypes import c_bool, c_int, c_int64, c_void_p
from pathlib import Path

import pytest

from router.carrier.build import LIBRARY, NATIVE, build, compile_c, sources
from router.library import load

MEMORY = "address,undefined"
RACES = "thread"


_SEAMS: Mapping[str, tuple[type | None, tuple[type, ...]]] = {
    "seam_hide": (None, (c_void_p, c_bool)),
    "seam_lock": (None, (c_void_p,)),
    "seam_next_due": (c_int64, (c_void_p,)),
    "seam_refuse": (None, (c_void_p, c_int)),
    "seam_hear": (None, (c_void_p, c_void_p)),
    "seam_timer": (c_int, (c_void_p,)),
    "seam_unlock": (None, (c_void_p,)),
    "seam_wakes_at": (c_int64, (c_void_p,)),
}


def sanitizing(sanitizers: str) -> list[str]:
    """Compiler flags. The first error that a sanitizer finds ends the process."""
    return [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-g", "-O1"]


def sanitized_library(output: Path) -> Path:
    """The library with AddressSanitizer and UndefinedBehaviorSanitizer, for processes that preload libasan."""
    # As in the library itself, because test libraries that use it have functions of the same names.
    return build(output, [*sanitizing(MEMORY), "-Wl,-Bsymbolic"], "gcc")


def seams(output: Path) -> ctypes.CDLL:
    """The functions of seams.c, compiled to the library `output`."""
    compile_c(["-shared", "-fPIC", str(Path(__file__).parent / "seams.c"), f"-I{NATIVE}", "-o", str(output)])
    loaded = ctypes.CDLL(str(output))
    for name, (returned, taken) in _SEAMS.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = returned, taken
    return loaded


def clocked_library(output: Path) -> ctypes.CDLL:
    """The library with simulated clocks, set by `seam_boottime` and `seam_wall`."""
    here = Path(__file__).parent
    clock = output.with_suffix(".c")
    clock.write_text("#include <stdint.h>\nint64_t seam_boottime, seam_wall;\n")
    flags = ["-O2", "-fPIC", "-shared", "-include", str(here / "clocked.h"), f"-I{NATIVE}"]
    compile_c([*flags, str(clock), *map(str, sources()), "-o", str(output)])
    return load(output)


def program(output: Path, main: Path, flags: Sequence[str], compiler: str | None = None) -> Path:
    """Compile a program from `main` and all sources of the carrier. Raises BuildError."""
    compile_c([str(main), *map(str, sources()), f"-I{NATIVE}", *flags, "-o", str(output)], compiler)
    return output


def run_program(name: str, folder: Path, *arguments: object, sanitizers: str = "") -> None:
    """Compile `programs/NAME.c` in `folder` and run it. Fails if the program fails or a sanitizer finds an error.

    Without sanitizers the program uses the existing library.
    """
    if sanitizers and shutil.which("clang") is None:
        pytest.skip("needs clang")
    main, made = Path(__file__).parent / "programs" / f"{name}.c", folder / name
    if sanitizers:
        program(made, main, sanitizing(sanitizers), "clang")
    else:
        compile_c(["-O2", str(main), f"-I{NATIVE}", str(LIBRARY), f"-Wl,-rpath,{NATIVE}", "-o", str(made)])
    done = subprocess.run([made, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
