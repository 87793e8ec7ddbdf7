"""The carrier's sources, compiled for tests: as a library with a few seams, and as programs with sanitizers."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from ctypes import c_bool, c_int, c_int64, c_size_t, c_uint16, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path

import pytest

_HERE = Path(__file__).parent
_NATIVE = _HERE.parents[1] / "router" / "carrier" / "native"
_SOURCES = [_NATIVE / f"{name}.c" for name in ("deadman", "freshness", "ring", "sender")]
_FLAGS = ["-std=c11", "-D_GNU_SOURCE", "-pthread", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]

_FUNCTIONS: dict[str, tuple[type | None, tuple[type, ...]]] = {
    "command_send": (c_int, (c_void_p, c_void_p, c_void_p, c_size_t, c_int64, c_void_p, c_uint32)),
    "command_send_at": (c_int, (c_void_p, c_void_p, c_void_p, c_size_t, c_int64, c_void_p, c_uint32, c_int64)),
    "deadman_close": (None, (c_void_p, c_void_p)),
    "deadman_end": (None, (c_void_p, c_void_p)),
    "deadman_open": (c_void_p, (c_void_p, c_int64, c_int64, c_uint32, c_uint32, c_uint32, c_void_p, c_uint32)),
    "deadman_replace": (None, (c_void_p, c_void_p, c_void_p)),
    "deadman_start": (c_uint64, (c_void_p, c_void_p)),
    "deadmen_open": (c_void_p, (c_void_p, c_void_p)),
    "deadmen_serve": (None, (c_void_p, c_int64)),
    "freshness_born": (c_int64, (c_void_p, c_int64, c_int64, c_int64)),
    "ring_close": (None, (c_void_p,)),
    "ring_drop": (c_bool, (c_void_p, c_void_p, c_size_t)),
    "ring_open": (c_void_p, (c_size_t,)),
    "ring_put": (c_bool, (c_void_p, c_void_p, c_uint32)),
    "ring_take": (c_size_t, (c_void_p, c_void_p, c_size_t, c_int)),
    "ring_taken": (c_uint64, (c_void_p,)),
    "ring_wake": (None, (c_void_p,)),
    "ring_watch": (c_int, (c_void_p,)),
    "ring_written": (c_uint64, (c_void_p,)),
    "seam_limit_passes": (c_bool, (c_void_p, c_int64)),
    "seam_lock": (None, (c_void_p,)),
    "seam_next_due": (c_int64, (c_void_p,)),
    "seam_set_reconnected": (None, (c_void_p, c_int64)),
    "seam_timer": (c_int, (c_void_p,)),
    "seam_timer_set_for": (c_int64, (c_void_p,)),
    "seam_unlock": (None, (c_void_p,)),
    "sender_close": (None, (c_void_p,)),
    "sender_end": (None, (c_void_p,)),
    "sender_open": (c_void_p, (c_int, c_uint32, c_uint16)),
    "sender_send": (c_int, (c_void_p, c_void_p, c_size_t)),
    "sender_send_checked": (c_int, (c_void_p, c_void_p, c_size_t)),
}


@cache
def library() -> ctypes.CDLL:
    """The library; skips the test where there is no compiler."""
    compiler = shutil.which("cc") or pytest.skip("no C compiler")
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "carrier.so"
        _compile(compiler, ["-O2", "-shared", "-fPIC", "-o", str(made), str(_HERE / "seams.c")])
        loaded = ctypes.CDLL(str(made))
    for name, (returned, taken) in _FUNCTIONS.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = returned, taken
    return loaded


def run_program(name: str, folder: Path, *arguments: object, sanitizers: Sequence[str] = ()) -> str:
    """Compile and run `programs/NAME.c`, and return what it prints; fails if it does or a sanitizer complains.

    Skips the test where there is no compiler; sanitizers need clang.
    """
    wanted = "clang" if sanitizers else "cc"
    compiler = shutil.which(wanted) or pytest.skip(f"no {wanted}")
    checks = [f"-fsanitize={','.join(sanitizers)}", "-fno-sanitize-recover=all", "-g"] if sanitizers else []
    made = folder / name
    _compile(compiler, ["-O1", *checks, "-o", str(made), str(_HERE / "programs" / f"{name}.c")])
    done = subprocess.run([made, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _compile(compiler: str, arguments: Sequence[str]) -> None:
    command = [compiler, *_FLAGS, f"-I{_NATIVE}", *arguments, *map(str, _SOURCES)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
