"""The library is loaded only where it is what Python expects, and says so otherwise."""

from __future__ import annotations

import ctypes
import os
import shutil
from pathlib import Path

import pytest

from router import declared, library
from router.carrier import build
from router.errors import StartError
from router.library import load


def test_without_a_library_nothing_runs(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="was not built, and nothing runs without it; run 'make setup'"):
        load(tmp_path / "libcarrier.so")


SOURCES = ["native/route.c", "native/wire.h", "build.py", "headers.py"]


@pytest.fixture
def installed(built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A library built after the sources beside it were changed last."""
    made = Path(shutil.copy(built, tmp_path))
    (tmp_path / "native").mkdir()
    for source in SOURCES:
        (tmp_path / source).touch()
    _say(tmp_path, declared.CHECKSUM)
    for source in SOURCES:
        os.utime(tmp_path / source, ns=(0, made.stat().st_mtime_ns - 1))
    monkeypatch.setattr(library, "_CARRIER", str(tmp_path))
    monkeypatch.setattr(library, "NATIVE", str(tmp_path / "native"))
    return made


def _say(folder: Path, checksum: str) -> None:
    """Write a build script that returns this checksum of the sources. Its time of modification is that of before."""
    script = folder / "build.py"
    times = script.stat()
    script.write_text(f"def checksum():\n    return {checksum!r}\n")
    os.utime(script, ns=(times.st_atime_ns, times.st_mtime_ns))


@pytest.mark.parametrize("changed", SOURCES)
def test_a_library_of_other_sources_is_refused(installed: Path, changed: str) -> None:
    _say(installed.parent, "0" * 64)
    load(installed)  # no source was changed since: none is read
    os.utime(installed.parent / changed, ns=(0, installed.stat().st_mtime_ns))
    with pytest.raises(StartError, match="was built from other sources; run 'make setup'"):
        load(installed)


def test_sources_that_are_younger_and_the_same_are_no_others(installed: Path) -> None:
    (installed.parent / "native" / "route.c").touch()
    load(installed)


def test_what_builds_the_library_and_what_loads_it_name_the_same_file_and_sources() -> None:
    assert Path(library.LIBRARY) == build.LIBRARY
    assert library._checksum() == build.checksum()


def test_what_is_no_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "libcarrier.so"
    path.write_bytes(b"\x7fELF of another architecture")
    with pytest.raises(StartError, match=r"cannot be loaded: .*; run 'make setup'"):
        load(path)


def test_declarations_of_other_sources_are_refused(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(declared, "CHECKSUM", "0" * 64)
    with pytest.raises(StartError, match="was built from other sources; run 'make setup'"):
        load(built)


RCL = {
    "rcl/types.h": "enum { RCL_RET_SUBSCRIPTION_TAKE_FAILED = 401 };",
    "rcutils/error_handling.h": "typedef struct { char str[1024]; } rcutils_error_string_t;",
    "rcutils/types/uint8_array.h": """
#include <stddef.h>
#include <stdint.h>
typedef struct { void *allocate, *deallocate, *reallocate, *zero_allocate, *state; } rcutils_allocator_t;
typedef struct {
    uint8_t *buffer; size_t buffer_length; size_t buffer_capacity; rcutils_allocator_t allocator;
} rcutils_uint8_array_t;
""",
    "rmw/types.h": """
#define RMW_GID_STORAGE_SIZE 16u
typedef struct { const char *implementation_identifier; uint8_t data[RMW_GID_STORAGE_SIZE]; } rmw_gid_t;
typedef struct {
    int64_t source_timestamp, received_timestamp; uint64_t publication_sequence_number, reception_sequence_number;
    rmw_gid_t publisher_gid;
} rmw_message_info_t;
#define RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED UINT64_MAX
""",
}
"""Headers like those of rcl, as far as they are used."""


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ("401", "402"),
        ("size_t buffer_length; size_t buffer_capacity;", "size_t buffer_capacity; size_t buffer_length;"),
        ("*allocate, *deallocate", "*deallocate, *allocate"),
        ("source_timestamp, received_timestamp", "received_timestamp, source_timestamp"),
        ("[1024]", "[2048]"),
        (
            "publication_sequence_number, reception_sequence_number",
            "reception_sequence_number, publication_sequence_number",
        ),
        ("UINT64_MAX", "0"),
        ("16u", "24u"),
    ],
)
def test_other_headers_of_rcl_are_noticed(ours: str, theirs: str, tmp_path: Path) -> None:
    assert not _differ(RCL, tmp_path / "same")
    changed = {name: text.replace(ours, theirs) for name, text in RCL.items()}
    assert changed != RCL
    assert _differ(changed, tmp_path / "changed")


def _differ(headers: dict[str, str], folder: Path) -> bool:
    for name, text in headers.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    made = folder / "check.so"
    build.compile_c(["-shared", "-fPIC", f"-isystem{folder}", str(build.NATIVE / "library.c"), "-o", str(made)])
    return bool(ctypes.CDLL(str(made)).rcl_types_differ() & 0xFF)


def test_the_installed_headers_of_rcl_are_those_that_we_declare(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    assert build.rcl_headers()  # or nothing is compared
    assert not load(build.build(tmp_path / "libcarrier.so", flags=())).rcl_types_differ()
