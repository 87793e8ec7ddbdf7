"""The library is loaded only where it is what Python expects, and says so otherwise."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

import pytest

from router.carrier import build, library, structures
from router.carrier.library import FUNCTIONS, STRUCTURES, load
from router.errors import StartError

HEADERS = "".join(path.read_text() for path in sorted(build.NATIVE.glob("*.h")))
PROTOTYPE = re.compile(r"^(\w[\w ]*?[ *]+)(\w+)\(([^()]+)\);", re.MULTILINE)
KINDS = {
    "void": None,
    "bool": ctypes.c_bool,
    "int": ctypes.c_int,
    "int64_t": ctypes.c_int64,
    "size_t": ctypes.c_size_t,
    "uint16_t": ctypes.c_uint16,
    "uint32_t": ctypes.c_uint32,
    "uint64_t": ctypes.c_uint64,
}


def kind(declared: str) -> type | None:
    """The type that ctypes has for that of a parameter, with its name, or of a function."""
    if "*" in declared:
        return ctypes.c_void_p
    first, *more = declared.split()
    return STRUCTURES[more[0]] if first == "struct" else KINDS[first]


def test_functions_are_declared_as_in_the_headers() -> None:
    declared = {
        name: (kind(returned), tuple(kind(each.strip()) for each in taken.split(",") if each != "void"))
        for returned, name, taken in PROTOTYPE.findall(HEADERS)
        if name in FUNCTIONS
    }
    assert declared == FUNCTIONS


def test_python_calls_nothing_that_is_not_declared() -> None:
    """ctypes would cut its pointers to 32 bits."""
    exported = {name for _, name, _ in PROTOTYPE.findall(HEADERS)}
    router = build.NATIVE.parents[1]
    called = {name for path in router.rglob("*.py") for name in re.findall(r"library\.(\w+)", path.read_text())}
    assert called & exported <= FUNCTIONS.keys()


def test_structures_have_their_fields_where_c_has_them(tmp_path: Path) -> None:
    lines = [
        f'printf("{name} {field[0]} %zu %zu\\n", offsetof(struct {name}, {field[0]}), sizeof(struct {name}));'
        for name, structure in STRUCTURES.items()
        for field in structure._fields_
    ]
    main = tmp_path / "offsets.c"
    headers = "".join(f"#include {name}\n" for name in ("<stdio.h>", '"collect.h"', '"from_ros.h"', '"publish.h"'))
    main.write_text(f"{headers}int main(void) {{ {' '.join(lines)} }}\n")
    build.compile_c([str(main), f"-I{build.NATIVE}", "-o", str(tmp_path / "offsets")])
    printed = subprocess.check_output([tmp_path / "offsets"], text=True)
    assert printed.splitlines() == [
        f"{name} {field[0]} {getattr(structure, field[0]).offset} {ctypes.sizeof(structure)}"
        for name, structure in STRUCTURES.items()
        for field in structure._fields_
    ]


def test_without_a_library_nothing_runs(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="was not built, and nothing runs without it; run 'make setup'"):
        load(tmp_path / "libcarrier.so")


def test_a_library_of_other_sources_is_refused(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "checksum", lambda: "0" * 64)
    with pytest.raises(StartError, match="was built from other sources; run 'make setup'"):
        load(built)


def test_what_is_no_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "libcarrier.so"
    path.write_bytes(b"\x7fELF of another architecture")
    with pytest.raises(StartError, match=r"cannot be loaded: .*; run 'make setup'"):
        load(path)


def test_structures_of_another_size_are_refused(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "STRUCTURES", {**STRUCTURES, "entry": structures.Feed, "more": structures.Feed})
    with pytest.raises(StartError, match="C and Python differ about struct entry, more"):
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
    build.compile_c(["-shared", "-fPIC", f"-isystem{folder}", str(build.NATIVE / "rcl_check.c"), "-o", str(made)])
    return bool(ctypes.CDLL(str(made)).rcl_types_differ() & 0xFF)


def test_the_installed_headers_of_rcl_are_those_that_we_declare(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    assert build.rcl_headers()  # or nothing is compared
    assert not load(build.build(tmp_path / "libcarrier.so", flags=())).rcl_types_differ()
