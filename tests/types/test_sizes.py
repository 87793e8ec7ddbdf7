"""Largest encodings, compared with what nanopb's own generator writes for the boards."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from router.types.boards import largest_encoding
from router.types.protobuf import Envelope, ProtoSchema, load_protos
from tests.tables import PROTOS
from tests.types.conftest import settings, with_envelope

Write = Callable[[Mapping[str, str]], Path]

_SIZE = re.compile(r"^#define (\w+)_size\s+(\d+)$", re.MULTILINE)


def nanopb_sizes(root: Path, output: Path) -> dict[str, int]:
    """Every `*_size` macro with a known value, by message. In a process of its own: nanopb fills the default pool."""
    output.mkdir(exist_ok=True)
    names = [path.relative_to(root).as_posix() for path in sorted(root.rglob("*.proto"))]
    command = [
        sys.executable,
        "-m",
        "nanopb.generator.nanopb_generator",
        "-q",
        "-I",
        str(root),
        "-D",
        str(output),
        *names,
    ]
    subprocess.run(command, cwd=root, check=True, capture_output=True, timeout=60)
    headers = "\n".join(path.read_text() for path in output.rglob("*.pb.h"))
    return {name: int(size) for name, size in _SIZE.findall(headers)}


def our_sizes(schema: ProtoSchema) -> dict[str, int]:
    sizes = {
        name.replace(".", "_"): largest_encoding(schema.descriptor(name), schema.board_options)
        for name in schema.messages
    }
    return {name: size for name, size in sizes.items() if size is not None}


def test_the_rovers_messages_are_as_large_as_nanopb_says(
    rover_schema: ProtoSchema, rover_envelope: Envelope, tmp_path: Path
) -> None:
    expected = nanopb_sizes(PROTOS, tmp_path)
    assert our_sizes(rover_schema) == expected
    assert rover_envelope.max_size == expected["PBEnvelope"]


def test_every_kind_of_field_is_as_large_as_nanopb_says(write: Write, tmp_path: Path) -> None:
    root = write(
        {
            "p/every.proto": 'syntax = "proto3";\n'
            "enum Small { S0 = 0; S1 = 127; }\n"
            "enum Large { L0 = 0; L1 = 128; L2 = 70000; }\n"
            "enum Negative { N0 = 0; N1 = -1; }\n"
            "message Scalars {\n"
            "  bool a = 1; float b = 2; double c = 3; int32 d = 4; int64 e = 5; uint32 f = 6; uint64 g = 7;\n"
            "  sint32 h = 8; sint64 i = 9; fixed32 j = 10; fixed64 k = 11; sfixed32 l = 12; sfixed64 m = 13;\n"
            "  Small n = 14; Large o = 15; Negative p = 16; optional int32 q = 17; float r = 3000; float s = 300000;\n"
            "}\n"
            "message Choice { oneof c { Scalars s = 1; bool flag = 2; } oneof d { double x = 3; float y = 4; } }\n"
            "message Empty {}\n"
            "message Bounded {\n"
            "  string s = 1; string t = 2; bytes b = 3; bytes fixed = 4; string long_text = 5;\n"
            "  repeated int32 r = 6; repeated Choice c = 7; repeated float one = 8; repeated uint32 fixed_count = 9;\n"
            "  repeated string texts = 10; Empty empty = 11; optional string maybe = 12;\n"
            "}\n"
            "message Outer { Bounded bounded = 1; message Inner { string name = 1; } Inner inner = 2; }\n"
            "message Unbounded { repeated float values = 1; }\n"
            "message Pointed { string s = 1; }\n"
            "message Wild { string first_name = 1; string last_name = 2; bytes other = 3; }\n",
            "p/every.options": "# as nanopb reads it\n"
            "Bounded.s max_size:16 // with its NUL\n"
            "Bounded.t  max_length:16, max_size:3\n"
            "Bounded.b\tmax_size:127\n"
            "Bounded.fixed max_size:128 fixed_length:true\n"
            "Bounded.long_text max_size:129\n"
            "Bounded.r max_count:5\n"
            "Bounded.c max_count:2 /* two */\n"
            "Bounded.one max_count:1\n"
            "Bounded.fixed_count max_count:4 fixed_count:true\n"
            "Bounded.texts max_count:3 max_size:8\n"
            "Bounded.maybe max_size:4; type:FT_STATIC\n"
            "Outer.Inner.* max_size:40\n"
            "Pointed.s max_size:8 type:FT_POINTER\n"
            "Wild max_size:9\n"
            "Wild.*_name max_length:20\n"
            "*.last_name max_length:30 long_names:false\n",
        }
    )
    assert our_sizes(load_protos(*settings(with_envelope(root)))) == nanopb_sizes(root, tmp_path / "out")


def test_message_inside_itself_has_no_largest_encoding(load: Callable[[Mapping[str, str]], ProtoSchema]) -> None:
    schema = load({"a.proto": 'syntax = "proto3";\nmessage A { B b = 1; }\nmessage B { A a = 1; }'})
    assert largest_encoding(schema.descriptor("A"), schema.board_options) is None


@pytest.mark.parametrize("value", [0, 1, -1, 2**31 - 1, -(2**31)])
def test_nothing_encodes_larger_than_the_largest_encoding(rover_envelope: Envelope, value: int) -> None:
    case = rover_envelope.cases["load_cell_info"]
    message = case.message_class(
        sensor_index=value & 0xFFFFFFFF, force_newtons=1.5, mass_grams=1.5, raw_counts=value, is_calibrated=True,
        scale_newtons_per_count=1.5, tare_offset_counts=value, state=3, error_code=5,
    )  # fmt: skip
    assert case.max_size is not None
    assert len(message.SerializeToString()) <= case.max_size
