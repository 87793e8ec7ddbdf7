"""What Python gets of the headers: everything in them that it can use, as C has it."""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from router import declared
from router.carrier import build
from router.carrier.headers import HeaderError, checks, declarations
from router.compiler.metrics import DROP_REASONS, REJECT_REASONS
from router.compiler.refusals import DROP_REASON_NAMES, REJECTIONS
from router.table.model.targets import Priority

HEADER = """
#ifndef A_H
#define A_H
/* struct comment { int x; }; */
#include "first.h"
#define NEVER INT64_MAX
#define TWICE(x) \\
    ((x) + (x))
enum { MOST = 1 << 4, MORE };
enum kind { KIND_FIRST = 3, KIND_SECOND };
enum { KINDS = KIND_SECOND + 1 };
struct unknown;
struct inside {
    const struct unknown *unknown; /* nobody says what this is */
    uint8_t one, several[MOST];
};
struct outside {
    struct inside inside;
    const struct inside *const *many, *next;
    union {
        int64_t integer;
        double real;
    };
    const char *text;
    bool is_there;
};
struct for_c_alone {
    _Atomic int count;
    struct inside inside;
};
struct called {
    void (*function)(int);
};
struct on_it {
    struct for_c_alone it;
};
typedef void handler(int number);
static inline bool hidden(struct inside *of) { if (of) { return true; } return false; }
struct inside *find(const struct unknown *in, uint16_t number, handler *handler);
void nothing(void);
struct first taken(enum kind kind);
#endif
"""
FIRST = "#pragma once\n#include <stdbool.h>\n#include <stdint.h>\nstruct first { uint32_t size; };\n"


@pytest.fixture
def headers(tmp_path: Path) -> Path:
    folder = tmp_path / "native"
    folder.mkdir()
    (folder / "a.h").write_text(HEADER)
    (folder / "first.h").write_text(FIRST)
    return folder


def made(headers: Path) -> ModuleType:
    path = headers / "made.py"
    path.write_text(declarations(headers, "a checksum"))
    spec = spec_from_file_location("made", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compiles(headers: Path, text: str) -> bool:
    checked = headers / "checked.c"
    checked.write_text(text)
    try:
        build.compile_c([str(checked), "-fsyntax-only"])
    except build.BuildError:
        return False
    return True


def test_constants_enums_structures_and_functions_are_those_of_the_headers(headers: Path) -> None:
    module = made(headers)
    assert (module.CHECKSUM, module.MOST, module.MORE, module.NEVER) == ("a checksum", 16, 17, 2**63 - 1)
    assert ([(each.name, each) for each in module.Kind], module.KINDS) == ([("FIRST", 3), ("SECOND", 4)], 5)
    assert {*module.STRUCTURES} == {"first", "inside", "outside"}
    assert {
        "find": (ctypes.c_void_p, (ctypes.c_void_p, ctypes.c_uint16, ctypes.c_void_p)),
        "nothing": (None, ()),
        "taken": (module.First, (ctypes.c_int,)),
    } == module.FUNCTIONS
    outside = module.Outside(next=ctypes.pointer(module.Inside(one=7)), real=1.0, text=b"text")
    assert (outside.next[0].one, outside.integer, outside.text) == (7, 0x3FF0_0000_0000_0000, b"text")


def test_an_enum_is_made_when_it_is_used_and_once(headers: Path) -> None:
    module = made(headers)
    assert "Kind" not in vars(module)
    assert module.Kind is module.Kind
    assert "Kind" in vars(module)
    with pytest.raises(AttributeError, match="the headers declare no Kinds"):
        _ = module.Kinds


def test_the_compiler_finds_what_was_not_read_as_it_reads_it(headers: Path) -> None:
    module = made(headers)
    text = checks(headers, module)
    assert compiles(headers, text)
    assert not compiles(headers, text.replace("MORE == 17", "MORE == 18"))
    header = headers / "a.h"
    header.write_text(HEADER.replace("uint8_t one", "uint8_t one, another"))
    assert not compiles(headers, text)
    header.write_text(HEADER.replace("int64_t integer;", "int32_t integer[5];"))
    assert not compiles(headers, text)


def test_a_build_compares_both(headers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (headers / "a.c").write_text('#include "a.h"\n')
    monkeypatch.setattr(build, "NATIVE", headers)
    build.build(headers / "libcarrier.so")
    (headers / "first.h").write_text(FIRST.replace("#pragma once", "#pragma once\n#pragma pack(1)"))
    with pytest.raises(build.BuildError, match=r"static assertion failed: .*struct outside"):
        build.build(headers / "libcarrier.so")


def test_a_declaration_without_an_end_is_refused(headers: Path) -> None:
    (headers / "z.h").write_text("struct last { int x; }")
    with pytest.raises(HeaderError, match="a declaration without an end: struct last"):
        declarations(headers, "")


def test_one_name_for_two_things_is_refused(headers: Path) -> None:
    (headers / "z.h").write_text("enum first { FIRST_ONE };")
    with pytest.raises(HeaderError, match="both a struct and an enum: First"):
        declarations(headers, "")


def test_python_calls_nothing_that_is_not_declared(library: ctypes.CDLL) -> None:
    """ctypes would cut its pointers to 32 bits."""
    router = build.NATIVE.parents[1]
    called = {name for path in router.rglob("*.py") for name in re.findall(r"library\.(\w+)", path.read_text())}
    assert {name for name in called if hasattr(library, name)} <= declared.FUNCTIONS.keys() | {"carrier_checksum"}


def test_reasons_are_named_as_in_metrics() -> None:
    assert tuple(REJECT_REASONS) == REJECTIONS
    assert {*DROP_REASON_NAMES} <= {*DROP_REASONS}
    assert [each.name for each in declared.Priority] == [each.name for each in Priority]


def test_it_is_read_without_any_package(headers: Path) -> None:
    root = str(build.NATIVE.parents[2])
    script = f"import sys; sys.path.insert(0, {root!r}); from router.carrier import headers"
    subprocess.run([sys.executable, "-I", "-S", "-c", script], check=True)
