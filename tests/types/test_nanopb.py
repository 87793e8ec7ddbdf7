"""nanopb's options, in `.options` files and in protos: the router reads them as nanopb's generator does."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from google.protobuf.descriptor import FieldDescriptor

from router.assets import asset
from router.errors import Code
from router.types.boards import board_findings, integers, is_list, is_required, longest, stored_type, why_unbounded
from router.types.lock import LockComparison
from router.types.nanopb import BoardOptions, read_options
from router.types.protobuf import ProtoSchema, find_envelope, load_protos
from tests.boards.board import OPTIONS
from tests.types.conftest import ONEOF, Load, Write, nanopb_headers, proto, refusal, settings
from tests.types.test_boards import SPAN, nanopb_sizes, our_sizes

FIELD = BoardOptions(is_apart=True)
"""The options of a field without any."""


def board_options(schema: ProtoSchema, field: str) -> BoardOptions:
    message, _, name = field.rpartition(".")
    return schema.board_options(schema.descriptor(message).fields_by_name[name])


# ---- `.options` files


def test_later_lines_win_and_a_field_wins_over_its_message(load: Load) -> None:
    lines = "A.x max_size:1\nA max_size:5 max_count:7\nA.x max_size:2\nA.x max_size:3\n"
    schema = load({"a.proto": proto("message A { string x = 1; string y = 2; } message B { string x = 1; }"),
                   "a.options": lines})  # fmt: skip
    options = {name: board_options(schema, name) for name in ("A.x", "A.y", "B.x")}
    assert options["A.x"] == replace(FIELD, max_size=3, max_count=7)
    assert options["A.y"] == replace(FIELD, max_size=5, max_count=7)
    assert options["B.x"] == FIELD


@pytest.mark.parametrize(
    ("line", "finding"),
    [
        ("A.x", "no option after the name; write for example 'max_size:16'"),
        ("A.x 16", "'16' is not a nanopb option; write for example 'max_size:16'"),
        ("A.x max_size:", "'max_size:' is not a nanopb option; write for example 'max_size:16'"),
        ("A.x max_size:many", "max_size cannot be 'many'"),
        ("A.x max_size:-1", "max_size cannot be '-1'"),
        ("A.x fixed_count:3", "fixed_count cannot be '3'"),
        ("A.x type:FT_STATC", "type cannot be 'FT_STATC'"),
        ("A.x max_szie:3", "nanopb has no option 'max_szie'; did you mean 'max_size'?"),
        ("A.x max_count:2 max_szie:3", "nanopb has no option 'max_szie'; did you mean 'max_size'?"),
    ],
)
def test_line_that_cannot_be_understood_is_a_finding(tmp_path: Path, line: str, finding: str) -> None:
    path = tmp_path / "a.options"
    path.write_text(f"# boards\n  {line}  # sizes\n")
    _, (found,) = read_options(path)
    assert str(found).startswith(f"{path}:2:3: error[bad-proto]: {finding}")


@pytest.mark.parametrize(
    "line",
    [
        'long_names:false packed_struct:true include:"x.h", exclude:["y.h", \'z.h\']',
        "skip_message:true; submsg_callback:true; fallback_type:FT_POINTER; anonymous_oneof:true",
        "callback_datatype:'void*' descriptorsize:DS_4 msgid:7 sort_by_tag:false initializer:\"{1, 2}\"",
    ],
)
def test_options_without_influence_on_what_a_board_takes_are_accepted(load: Load, line: str) -> None:
    schema = load({"a.proto": proto("message A { string x = 1; }"), "a.options": f"A.* {line}\n"})
    assert schema.warnings == ()
    assert board_options(schema, "A.x") == FIELD


NAMES = """\
syntax = "proto3";
package boat;
enum Mode { OFF = 0; }
message Hull { message Tank { string label = 1; } oneof fill { Tank water = 1; } enum Kind { WOOD = 0; } }
"""


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("*", None),
        ("boat.Mode", None),
        ("boat.Hull.fill", None),
        ("boat.Hull.Kind", None),
        ("boat.Hull.Tank", None),
        ("boat.Hull.*.label", None),
        ("boat.Hull.Tank.lable", "did you mean 'boat.Hull.Tank.label'?"),
        ("Hull.Tank.label", "names begin with the package: 'boat.Hull.Tank.label'"),
        ("Hull.*", "names begin with the package: 'boat.Hull.*'"),
    ],
)
def test_line_that_names_nothing_is_a_warning(write: Write, name: str, hint: str | None) -> None:
    schema = load_protos(*settings(write({"a.proto": NAMES, "a.options": f"{name} max_size:4\n"}), "boat.Hull"))
    assert [(found.code, found.hint) for found in schema.warnings] == ([(Code.UNUSED_OPTION, hint)] if hint else [])


def test_file_that_is_no_text_is_a_finding(tmp_path: Path) -> None:
    path = tmp_path / "a.options"
    path.write_bytes(b"\xff\xfe")
    _, (found,) = read_options(path)
    assert found.code is Code.BAD_FILE


# ---- options in protos

IMPORT = 'syntax = "proto3";\nimport "nanopb.proto";\n'


def test_an_option_in_a_proto_wins_over_the_lines_of_its_options_file(load: Load) -> None:
    schema = load({"a.proto": IMPORT + "message A { string x = 1 [(nanopb).max_size = 8]; string y = 2; }",
                   "a.options": "* max_size:64\n"})  # fmt: skip
    assert [board_options(schema, name).max_size for name in ("A.x", "A.y")] == [8, 64]


def test_lines_for_a_field_win_over_options_of_its_message_and_file(load: Load) -> None:
    text = "option (nanopb_fileopt).max_size = 9; message A { option (nanopb_msgopt).max_size = 8; string x = 1; %s }"
    schema = load({"a.proto": IMPORT + text % "string y = 2;", "a.options": "A.x max_size:7\n"})
    assert [board_options(schema, name).max_size for name in ("A.x", "A.y")] == [7, 8]


def test_options_of_a_message_do_not_apply_to_messages_in_it(load: Load) -> None:
    text = "message A { option (nanopb_msgopt).max_size = 8; message B { string x = 1; } B b = 1; }"
    assert board_options(load({"a.proto": IMPORT + text}), "A.B.x").max_size is None


def test_a_copy_of_nanopb_proto_in_the_folder_is_used_and_neither_locked_nor_listed(write: Write) -> None:
    own = asset("schemas/nanopb.proto").read_text().replace("optional bool discard_deprecated", "// ")
    root = write({"nanopb.proto": own, "e.proto": IMPORT + ENVELOPE})
    schema = load_protos(*settings(root))
    lock = LockComparison(find_envelope(schema, ONEOF)).extended()
    assert schema.files == ("e.proto",)
    assert sorted([*lock.messages, *lock.enums]) == ["A", "Envelope"]
    assert board_options(schema, "A.x").max_size == 8


def test_nanopb_proto_need_not_be_in_the_folder(write: Write) -> None:
    root = write({"protos/e.proto": IMPORT + ENVELOPE, "nanopb.proto": "something else"}) / "protos"
    schema = load_protos(*settings(root))
    lock = LockComparison(find_envelope(schema, ONEOF)).extended()
    assert sorted([*lock.messages, *lock.enums]) == ["A", "Envelope"]
    assert board_options(schema, "A.x").max_size == 8


ENVELOPE = """
message A { string x = 1 [(nanopb).max_size = 8]; }
message Envelope { oneof payload { A a = 1; A b = 2 [(nanopb).type = FT_IGNORE]; } }
"""


def test_a_wrong_option_in_a_proto_is_a_finding_at_its_place(write: Write) -> None:
    root = write({"e.proto": IMPORT + "message Envelope {\n  string x = 1 [(nanopb).max_szie = 8];\n}\n"})
    (finding,) = refusal(root)
    assert (finding.code, finding.span.file, finding.span.line) == (Code.BAD_PROTO, "e.proto", 4)
    assert "max_szie" in finding.message


def test_a_payload_that_the_firmware_leaves_out_is_not_for_boards(load: Load) -> None:
    schema = load({"e.proto": IMPORT + ENVELOPE})
    envelope = find_envelope(schema, ONEOF)
    assert board_findings(envelope.cases["a"], schema, envelope.max_size, SPAN) == []
    (finding,) = board_findings(envelope.cases["b"], schema, envelope.max_size, SPAN)
    assert (finding.code, finding.message) == (
        Code.BOARD_PAYLOAD, "a board ignores b: nanopb's options leave it out of the firmware"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("field", "why"),
    [
        ("repeated int32 x = 1 [(nanopb).label_override = LABEL_OPTIONAL];",
         "is repeated, but has one value in the firmware, by label_override"),
        ("int32 x = 1 [(nanopb).type_override = TYPE_FIXED32];",
         "has another wire type in the firmware, by type_override"),
        ("int32 x = 1 [(nanopb).label_override = LABEL_REPEATED];", "is repeated without a max_count"),
    ],
)  # fmt: skip
def test_a_field_that_the_firmware_decodes_otherwise_is_not_for_boards(load: Load, field: str, why: str) -> None:
    schema = load({"a.proto": IMPORT + f"message A {{ {field} }}"})
    x = schema.descriptor("A").fields_by_name["x"]
    assert why_unbounded(x, schema.board_options(x)) == why


# ---- as the generator does


class Stored(NamedTuple):
    """How the firmware stores a field, with the sizes of its arrays.

    `rules` is REQUIRED, REPEATED, FIXARRAY, ONEOF or OTHER. `bits` are those of an integer that `int_size` shortens,
    else 0.
    """

    is_static: bool
    rules: str
    sizes: tuple[int, ...] = ()
    bits: int = 0


_FIELDS = re.compile(r"#define (\w+)_FIELDLIST\(X, \w+\) \\\n((?:X\(.*\n)*)")
_FIELD = re.compile(r"X\(\w+, (\w+), +(\w+), +(\w+), +\(?(?:\w+,)?(\w+)[^ ]* +\d+\)")
_STRUCT = re.compile(r"typedef struct _(\w+) \{\n(.*?)\n\}", re.DOTALL)
_MEMBER = re.compile(r"^ +(\w+) (\w+)((?:\[\d+\])*);", re.MULTILINE)
_BYTES = re.compile(r"typedef PB_BYTES_ARRAY_T\((\d+)\) (\w+);")


def in_headers(headers: str) -> dict[str, Stored]:
    """What nanopb's headers say of each field, by C name of its message and its own."""
    blobs = {name: int(size) for size, name in _BYTES.findall(headers)}
    members = {
        f"{struct}.{name}": (kind, tuple(map(int, re.findall(r"\d+", sizes))))
        for struct, body in _STRUCT.findall(headers)
        for kind, name, sizes in _MEMBER.findall(body)
    }
    found = {}
    for message, fields in _FIELDS.findall(headers):
        for allocation, rules, kind, name in _FIELD.findall(fields):
            ctype, sizes = members.get(f"{message}.{name}", ("", ()))
            bits = re.fullmatch(r"u?int(\d+)_t", ctype)
            is_short = bits is not None and int(bits[1]) < (64 if kind.endswith("64") else 32) and "FIXED" not in kind
            found[f"{message}.{name}"] = Stored(
                allocation == "STATIC",
                rules if rules in {"REQUIRED", "REPEATED", "FIXARRAY", "ONEOF"} else "OTHER",
                (*sizes, *([blobs[ctype]] if ctype in blobs else [])) if allocation == "STATIC" else (),
                int(bits[1]) if bits is not None and is_short else 0,
            )
    return found


def in_schema(schema: ProtoSchema) -> dict[str, Stored]:
    """What the router expects of each field, likewise."""
    messages = [name for name in schema.messages if schema.sources.file(name) in schema.files]
    return {
        f"{name.replace('.', '_')}.{field.name}": expected(field, schema.board_options(field))
        for name in messages
        for field in schema.descriptor(name).fields
        if not schema.board_options(field).is_ignored
    }


def expected(field: FieldDescriptor, options: BoardOptions) -> Stored:
    rules = "OTHER"
    if field.containing_oneof is not None and not options.is_apart:
        rules = "ONEOF"
    elif is_list(field, options):
        rules = "FIXARRAY" if options.fixed_count else "REPEATED"
    elif is_required(field, options):
        rules = "REQUIRED"
    bits = kind.bits if (kind := integers(field, options)) is not None and field.enum_type is None else 0
    if why_unbounded(field, options):
        return Stored(False, rules, (), 0)
    sizes = [options.max_count] if rules in {"REPEATED", "FIXARRAY"} else []
    if field.type in {FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES}:
        size = longest(field, options)
        assert size is not None
        sizes += [size + (stored_type(field, options) == FieldDescriptor.TYPE_STRING)]
    return Stored(True, rules, tuple(size for size in sizes if size is not None), bits)


def compare(root: Path, output: Path, message: str = "Envelope") -> None:
    schema = load_protos(*settings(root, message))
    assert our_sizes(schema) == nanopb_sizes(root, output)
    assert in_schema(schema) == in_headers(nanopb_headers(root, output))


def test_the_protos_of_a_board_are_stored_as_nanopb_says(tmp_path: Path) -> None:
    schema = load_protos(*settings(OPTIONS, "PBEnvelope"))
    assert in_schema(schema) == in_headers(nanopb_headers(OPTIONS, tmp_path))
    assert our_sizes(schema) == nanopb_sizes(OPTIONS, tmp_path)
    assert find_envelope(schema, ONEOF).max_size == nanopb_sizes(OPTIONS, tmp_path)["PBEnvelope"]


PROTO2 = """syntax = "proto2";
import "nanopb.proto";
option (nanopb_fileopt) = {max_count: 3 max_size: 20};
enum E { option (nanopb_enumopt).long_names = false; E0 = 0; E1 = 300; }
message Labels {
  required int32 a = 1;
  required int32 b = 2 [(nanopb).label_override = LABEL_OPTIONAL];
  optional int32 c = 3 [(nanopb).label_override = LABEL_REQUIRED];
  optional uint32 d = 4 [(nanopb).label_override = LABEL_REPEATED];
  required string e = 5 [(nanopb).type = FT_CALLBACK];
}
message Types {
  optional int32 a = 1 [(nanopb).type_override = TYPE_UINT32];
  optional uint32 b = 2 [(nanopb) = {type_override: TYPE_INT32 int_size: IS_8}];
  optional E c = 3 [(nanopb).type_override = TYPE_INT32];
  optional string d = 4 [(nanopb).type_override = TYPE_BYTES];
  optional bytes e = 5 [(nanopb).type_override = TYPE_STRING];
  optional string f = 6 [(nanopb) = {type_override: TYPE_BYTES max_length: 9}];
  optional bytes g = 7 [(nanopb).type = FT_INLINE];
  optional bytes h = 8 [(nanopb).type = FT_POINTER];
  optional string i = 9 [(nanopb).fixed_length = true];
  optional int32 j = 10 [(nanopb).fixed_count = true];
}
message Old { optional int32 a = 1 [deprecated = true]; optional string b = 2; }
message Gone {
  option (nanopb_msgopt).discard_deprecated = true;
  optional int32 a = 1 [deprecated = true];
  optional string b = 2;
}
message Choice {
  option (nanopb_msgopt).submsg_callback = true;
  oneof one { Old a = 1; string b = 2; int64 c = 3; }
  oneof two { Old d = 4; sint32 e = 5 [(nanopb).int_size = IS_8]; }
  oneof three { int32 f = 6; }
}
message Sizes {
  option (nanopb_msgopt).int_size = IS_16;
  optional int32 a = 1; optional int64 b = 2; optional uint32 c = 3; optional uint64 d = 4; optional sint32 e = 5;
  optional sint64 f = 6; optional fixed32 g = 7; optional bool h = 8; optional E i = 9;
  repeated uint64 j = 10 [(nanopb).int_size = IS_64];
}
message Empty { optional Old a = 1 [(nanopb).type = FT_IGNORE]; }
message Envelope { optional Choice a = 1; optional Empty b = 2; }
"""
LINES = "Choice.two no_unions:true\nChoice.three type:FT_IGNORE\nOld.b max_length:4\nSizes.a int_size:IS_8\n"


def test_every_option_with_influence_is_understood_as_by_nanopb(write: Write, tmp_path: Path) -> None:
    compare(write({"p/e.proto": PROTO2, "p/e.options": LINES}) / "p", tmp_path / "out")


NAMED = """syntax = "proto3";
package boat.hull;
import "nanopb.proto";
option (nanopb_fileopt) = {%s};
message Tank { message Cap { string label = 1; } Cap cap = 1; }
message Envelope { Tank tank = 1; }
"""


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("", "boat.hull.Tank.Cap.label"),
        ("mangle_names: M_STRIP_PACKAGE", "Tank.Cap.label"),
        ("mangle_names: M_FLATTEN", "Cap.label"),
        ("mangle_names: M_PACKAGE_INITIALS", "bh.Tank.Cap.label"),
        ("package: 'ship'", "ship.Tank.Cap.label"),
    ],
)
def test_lines_name_fields_as_the_generated_code_does(write: Write, tmp_path: Path, option: str, name: str) -> None:
    root = write({"p/e.proto": NAMED % option, "p/e.options": f"{name} max_size:7\n"}) / "p"
    schema = load_protos(*settings(root, "boat.hull.Envelope"))
    assert schema.warnings == ()
    assert board_options(schema, "boat.hull.Tank.Cap.label").max_size == 7
    assert "char label[7];" in nanopb_headers(root, tmp_path / "out")
    (root / "e.options").write_text("hull.Tank.label max_size:7\n")
    assert [found.code for found in load_protos(*settings(root, "boat.hull.Envelope")).warnings] == [Code.UNUSED_OPTION]


class Random:
    """Random options in random places; the same seed gives the same ones."""

    OPTIONS = (
        "max_size", "max_length", "max_count", "int_size: IS_8", "int_size: IS_16", "int_size: IS_64",
        "fixed_length: true", "fixed_count: true", "fixed_count: false", "type: FT_CALLBACK", "type: FT_POINTER",
        "type: FT_IGNORE", "type: FT_DEFAULT", "no_unions: true", "fallback_type: FT_POINTER", "sort_by_tag: false",
        "anonymous_oneof: true", "discard_deprecated: true", "proto3_singular_msgs: true", "default_has: true",
    )  # fmt: skip
    TYPES = ("string", "bytes", "int32", "uint32", "sint32", "int64", "uint64", "sint64", "float", "fixed64", "bool")
    NAMES = ("*", "A", "B", "A.*", "B.f?", "A.f1", "A.f2", "B.f3", "A.one", "B.one", "*.f1", "A.C", "A.C.*", "e*")

    def __init__(self, seed: int) -> None:
        self._noise = random.Random(seed)

    def proto(self) -> str:
        inner = f"message C {{ {self._own('nanopb_msgopt')} {self._fields()} }}"
        return (
            f'syntax = "proto3";\nimport "nanopb.proto";\n{self._own("nanopb_fileopt")}\n'
            f"message A {{ {self._own('nanopb_msgopt')} {inner} {self._fields()} C c = 20; repeated C cs = 21; }}\n"
            f"message B {{ {self._own('nanopb_msgopt')} {self._fields()} A a = 20; }}\n"
            "message Envelope { B b = 1; }\n"
        )

    def lines(self) -> str:
        drawn = [f"{name} {' '.join(self._drawn())}" for name in self._noise.choices(self.NAMES, k=6)]
        return "\n".join(["* max_size:5 max_count:2", *drawn, ""])

    def _drawn(self) -> Iterator[str]:
        drawn = self._noise.sample(self.OPTIONS, self._noise.choice((1, 1, 2)))
        for option in {option.partition(":")[0]: option for option in drawn}.values():
            yield option if ":" in option else f"{option}: {self._noise.randrange(1, 200)}"

    def _own(self, extension: str) -> str:
        return f"option ({extension}) = {{{' '.join(self._drawn())}}};" if self._noise.random() < 0.3 else ""

    def _fields(self) -> str:
        fields = [self._field(number, self._noise.choice(("", "optional ", "repeated "))) for number in range(1, 7)]
        members = [self._field(number, "") for number in range(7, 10)]
        return f"{' '.join(fields)} oneof one {{ {' '.join(members)} }}"

    def _field(self, number: int, label: str) -> str:
        deprecated = ["deprecated = true"] if self._noise.random() < 0.1 else []
        own = [f"(nanopb) = {{{' '.join(self._drawn())}}}"] if self._noise.random() < 0.3 else []
        options = f" [{', '.join([*deprecated, *own])}]" if deprecated or own else ""
        return f"{label}{self._noise.choice(self.TYPES)} f{number} = {number}{options};"


@pytest.mark.parametrize("seed", range(8))
def test_random_options_are_merged_as_by_nanopb(write: Write, tmp_path: Path, seed: int) -> None:
    made = Random(seed)
    compare(write({"p/e.proto": made.proto(), "p/e.options": made.lines()}) / "p", tmp_path / "out")
