"""What boards can take: by hand, and the carrier against Python for any message."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.constants import envelope_of
from router.compiler.lowering.arrays import Arrays
from router.compiler.mapping import build
from router.declared import BoardRefusal, DropReason
from router.errors import Located, SourceSpan
from router.image.boards import write_boards
from router.table.model.expressions import FieldMap
from router.types.board_limits import BoardLimits, board_fields, scalars
from router.types.model import MessageType
from router.types.protobuf import find_envelope, load_protos
from tests.boards.board import REQUIRED
from tests.compiler.compiling import SPAN, field_map, scope_of
from tests.envelopes import I32, I64, VARINT, framed, tag, varint
from tests.oracles.boards import MISSING_FIELD, NON_FINITE, TOO_LARGE, Refusal, refusal

PROTOS = Path(__file__).parent / "protos_of_boards"
TEXTS, NUMBERS, TREE = 1, 2, 3
LONGEST = 120
REASONS = {DropReason.NON_FINITE: NON_FINITE, DropReason.TOO_LARGE: TOO_LARGE, DropReason.MISSING_FIELD: MISSING_FIELD}
"""Those of `enum drop_reason`."""

ONE = b"\0\0\x80\x3f"
NAN, INF = b"\0\0\xc0\x7f", b"\0\0\x80\x7f"
WIDE_INF = bytes(6) + b"\xf0\xff"


class Boards:
    """A board that refuses numbers that are not finite, and one that takes them; as Python and as C know them."""

    def __init__(self, library: ctypes.CDLL, protos: Path = PROTOS) -> None:
        span = SourceSpan("a test")
        schema = load_protos(Located(protos, span), Located("PBEnvelope", span))
        self.envelope = find_envelope(schema, Located("payload", span))
        fields = board_fields(schema.descriptor("PBEnvelope"), schema.board_options)
        longest = min(LONGEST, self.envelope.max_size)
        self.limits = {
            name: BoardLimits(fields, longest, allows) for name, allows in {"strict": False, "lenient": True}.items()
        }
        self._memory = Arrays()
        self._native = write_boards(self.limits, self._memory)
        self._takes = library.board_takes

    def carrier(self, data: bytes, board: str = "strict") -> Refusal | None:
        found = BoardRefusal()
        if self._takes(self._native[board], data, len(data), ctypes.byref(found)):
            return None
        return Refusal(REASONS[found.reason], found.text.decode())

    def refusal(self, data: bytes, board: str = "strict") -> Refusal | None:
        """What both say, which has to be the same."""
        found = refusal(self.limits[board], data)
        assert self.carrier(data, board) == found
        return found


@pytest.fixture(scope="module")
def boards(library: ctypes.CDLL) -> Boards:
    return Boards(library)


@pytest.fixture(scope="module")
def requiring(library: ctypes.CDLL) -> Boards:
    return Boards(library, REQUIRED)


TAKEN = {
    "nothing": b"",
    "an empty payload": framed(TEXTS, b""),
    "texts at their bounds": framed(TEXTS, framed(1, b"1234567") + framed(2, b"1234") + framed(3, b"1234")),
    "as many texts as fit": framed(TEXTS, framed(4, b"ab") * 2),
    "an empty key": framed(TEXTS, framed(3, b"")),
    "numbers": framed(NUMBERS, tag(1, I32) + ONE + tag(2, I64) + bytes(8)),
    "the largest float": framed(NUMBERS, tag(1, I32) + b"\xff\xff\x7f\x7f"),
    "packed numbers": framed(NUMBERS, framed(3, ONE * 3) + framed(5, varint(300) * 3)),
    "numbers one by one": framed(NUMBERS, (tag(3, I32) + ONE) * 3 + (tag(5, VARINT) + varint(1)) * 3),
    "packed and one by one": framed(NUMBERS, framed(3, ONE * 2) + tag(3, I32) + ONE),
    "both of a pair": framed(NUMBERS, framed(6, b"\1\2")),
    "lists in each of several": framed(TREE, framed(2, framed(3, ONE * 3)) * 2),
    "a list here and there": framed(TREE, framed(1, framed(3, ONE * 3)) + framed(2, framed(3, ONE * 3))),
    "a map": framed(TREE, framed(3, framed(1, b"abc") + framed(2, framed(3, ONE * 3)))),
    "an unknown field": framed(TEXTS, framed(99, bytes(50))),
    "a list of another wire type": framed(NUMBERS, (tag(5, I32) + ONE) * 5),
    "a number of another wire type": framed(NUMBERS, framed(1, NAN)),
}
REFUSED = {
    "an envelope that is too long": (framed(9, bytes(119)), "the envelope has 121 bytes; the board takes 120"),
    "a text": (framed(TEXTS, framed(1, b"12345678")), "texts.name has 8 bytes; the board takes 7"),
    "bytes": (framed(TEXTS, framed(2, bytes(5))), "texts.blob has 5 bytes; the board takes 4"),
    "a key that is too short": (framed(TEXTS, framed(3, b"123")), "texts.key has 3 bytes; the board takes 4"),
    "too many texts": (framed(TEXTS, framed(4, b"") * 3), "texts.names has 3 elements; the board takes 2"),
    "a long one among texts": (framed(TEXTS, framed(4, b"abc")), "texts.names has 3 bytes; the board takes 2"),
    "too many numbers": (framed(NUMBERS, framed(3, ONE * 4)), "numbers.floats has 4 elements; the board takes 3"),
    "too many varints": (framed(NUMBERS, framed(5, b"\1" * 4)), "numbers.integers has 4 elements; the board takes 3"),
    "none of a pair": (framed(NUMBERS, framed(6, b"")), "numbers.pair has 0 elements; the board takes 2"),
    "half of a pair": (framed(NUMBERS, framed(6, b"\1")), "numbers.pair has 1 element; the board takes 2"),
    "too many messages": (framed(TREE, framed(2, b"") * 3), "tree.many has 3 elements; the board takes 2"),
    "too many entries": (
        framed(TREE, b"".join(framed(3, framed(1, key)) for key in (b"a", b"b", b"c"))),
        "tree.named has 3 elements; the board takes 2",
    ),
    "the key of an entry": (
        framed(TREE, framed(3, framed(1, b"abcd"))),
        "tree.named.key has 4 bytes; the board takes 3",
    ),
    "deep inside": (
        framed(TREE, framed(2, b"") + framed(2, framed(3, ONE * 4))),
        "tree.many.floats has 4 elements; the board takes 3",
    ),
    "parts that are merged": (
        framed(TREE, framed(1, framed(3, ONE * 2)) * 2),
        "tree.one.floats has 4 elements; the board takes 3",
    ),
}
NOT_FINITE = {
    "nan": (framed(NUMBERS, tag(1, I32) + NAN), "numbers.small is nan"),
    "infinity": (framed(NUMBERS, tag(1, I32) + INF), "numbers.small is inf"),
    "a double": (framed(NUMBERS, tag(2, I64) + WIDE_INF), "numbers.large is -inf"),
    "packed": (framed(NUMBERS, framed(3, ONE + NAN)), "numbers.floats is nan"),
    "one by one": (framed(NUMBERS, tag(4, I64) + bytes(8) + tag(4, I64) + WIDE_INF), "numbers.doubles is -inf"),
    "in an entry": (framed(TREE, framed(3, framed(2, tag(1, I32) + NAN))), "tree.named.value.small is nan"),
    "beside the payload": (framed(TREE, b"") + tag(20, I32) + INF, "beside is inf"),
}


@pytest.mark.parametrize("data", TAKEN.values(), ids=TAKEN)
def test_what_fits_is_taken(boards: Boards, data: bytes) -> None:
    assert boards.refusal(data) is None


@pytest.mark.parametrize(("data", "text"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused_with_field_and_bound(boards: Boards, data: bytes, text: str) -> None:
    assert boards.refusal(data) == boards.refusal(data, "lenient") == Refusal(TOO_LARGE, text)


@pytest.mark.parametrize(("data", "text"), NOT_FINITE.values(), ids=NOT_FINITE)
def test_a_number_that_is_not_finite_is_refused_unless_it_is_allowed(boards: Boards, data: bytes, text: str) -> None:
    assert boards.refusal(data) == Refusal(NON_FINITE, text)
    assert boards.refusal(data, "lenient") is None


SPEED = tag(1, I32) + ONE
LEFT, NAME = framed(1, SPEED), framed(4, b"a")
DRIVE, STOP = framed(1, LEFT + NAME), framed(2, b"")
BESIDE = tag(9, VARINT) + b"\1" + framed(10, b"")
COMPLETE = {
    "what is required": DRIVE + BESIDE,
    "nothing is required in it": STOP + BESIDE,
    "a required field of zero": framed(1, framed(1, tag(1, I32) + bytes(4)) + framed(4, b"")) + BESIDE,
    "required fields in a list": framed(1, LEFT + NAME + framed(3, SPEED) * 2) + BESIDE,
    "two payloads with everything": STOP + DRIVE + BESIDE,
    "in each piece": DRIVE * 2 + BESIDE,
    "the envelope's, on both sides": BESIDE[:2] + DRIVE + BESIDE[2:],
}
INCOMPLETE = {
    "a text": (framed(1, LEFT) + BESIDE, "drive.name"),
    "a message": (framed(1, NAME) + BESIDE, "drive.left"),
    "a number in it": (framed(1, framed(1, b"") + NAME) + BESIDE, "drive.left.speed"),
    "a number in an optional message": (framed(1, LEFT + NAME + framed(2, b"")) + BESIDE, "drive.right.speed"),
    "a number in a list": (framed(1, LEFT + NAME + framed(3, SPEED) + framed(3, b"")) + BESIDE, "drive.others.speed"),
    "a number in a choice": (framed(1, LEFT + NAME + framed(5, b"")) + BESIDE, "drive.turbo.speed"),
    "of another wire type": (framed(1, framed(1, tag(1, I64) + bytes(8)) + NAME) + BESIDE, "drive.left.speed"),
    "everything": (framed(1, b"") + BESIDE, "drive.left"),
    "beside the payload": (STOP + BESIDE[2:], "robot"),
    "a text beside the payload": (STOP + BESIDE[:2], "sender"),
    "in a payload that another one follows": (framed(1, LEFT) + STOP + BESIDE, "drive.name"),
    "in one of two pieces": (framed(1, LEFT) + framed(1, NAME) + BESIDE, "drive.name"),
    "in one of two pieces of a message": (framed(1, LEFT + framed(1, b"") + NAME) + BESIDE, "drive.left.speed"),
}


@pytest.mark.parametrize("data", COMPLETE.values(), ids=COMPLETE)
def test_a_message_with_all_required_fields_is_taken(requiring: Boards, data: bytes) -> None:
    assert requiring.refusal(data) is None


@pytest.mark.parametrize(("data", "field"), INCOMPLETE.values(), ids=INCOMPLETE)
def test_a_missing_required_field_is_named(requiring: Boards, data: bytes, field: str) -> None:
    assert requiring.refusal(data) == Refusal(MISSING_FIELD, f"{field} is missing; the board requires it")


def test_a_required_field_without_a_bound_may_have_any_size(library: ctypes.CDLL, tmp_path: Path) -> None:
    for name in ("envelope.proto", "envelope.options"):
        text = (REQUIRED / name).read_text().replace("PBEnvelope.sender", "PBEnvelope.s*  type:FT_CALLBACK")
        (tmp_path / name).write_text(text)
    unbounded = Boards(library, tmp_path)
    assert unbounded.refusal(STOP + BESIDE + framed(10, bytes(20))) is None
    assert unbounded.refusal(STOP + BESIDE[:2]) == Refusal(MISSING_FIELD, "sender is missing; the board requires it")


@pytest.mark.parametrize(
    ("data", "text"),
    [
        pytest.param(framed(TEXTS, framed(1, bytes(8)) + framed(1, b"")), "texts.name", id="an earlier value"),
        pytest.param(framed(TEXTS, framed(1, bytes(8))) + framed(TREE, b""), "texts.name", id="an earlier payload"),
        pytest.param(framed(NUMBERS, tag(1, I32) + NAN + tag(1, I32) + ONE), "numbers.small", id="an earlier number"),
    ],
)
def test_what_a_later_field_replaces_counts_as_well(boards: Boards, data: bytes, text: str) -> None:
    """nanopb decodes it, and refuses it."""
    found = boards.refusal(data)
    assert found is not None
    assert found.text.startswith(text)


@pytest.mark.parametrize(
    ("case", "fields"),
    [
        ("texts", field_map(key="[1, 2]")),
        ("texts", field_map(keys="[[1, 2, 3, 4], []]", name="'seven'")),
        ("numbers", field_map(doubles="[1 / clamp(2.0, 0, 9), inf]")),
        ("numbers", field_map(small="3")),
        ("tree", field_map(one__large="-inf")),
    ],
)
def test_what_a_deadman_sends_is_judged_alike_before_it_is_sent(boards: Boards, case: str, fields: FieldMap) -> None:
    declared, limits = boards.envelope.cases[case], boards.limits["strict"]
    mapping = build(fields, declared.type, scope_of(MessageType("nothing")), SPAN)
    assert not mapping.findings
    datagram = envelope_of(mapping.plan, declared)
    said = [limits.misfit(*each) for each in scalars(boards.envelope.message_class.FromString(datagram), limits.fields)]
    found = boards.refusal(datagram)
    assert list(filter(None, said)) == ([found.text] if found else [])


# -- any message ------------------------------------------------------------------------------------------------------

FLOATS = st.sampled_from([0.0, 1.5, -2.0, math.nan, math.inf, -math.inf, 3.4028234663852886e38])


def maybe(**fields: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({}, optional=fields)


TEXT, DATA = st.text("ab", max_size=9), st.binary(max_size=6)
NUMBER = maybe(
    small=FLOATS,
    large=FLOATS,
    floats=st.lists(FLOATS, max_size=4),
    doubles=st.lists(FLOATS, max_size=3),
    integers=st.lists(st.integers(-9, 900), max_size=4),
    pair=st.lists(st.integers(-9, 900), max_size=3),
    plain=st.integers(-9, 9),
)
ENVELOPES = st.one_of(
    st.fixed_dictionaries(
        {
            "texts": maybe(
                name=TEXT,
                blob=DATA,
                key=DATA,
                names=st.lists(st.text("a", max_size=3), max_size=3),
                keys=st.lists(DATA, max_size=3),
            )
        }
    ),
    st.fixed_dictionaries({"numbers": NUMBER, "beside": FLOATS}),
    st.fixed_dictionaries(
        {
            "tree": maybe(
                one=NUMBER, many=st.lists(NUMBER, max_size=3), named=st.dictionaries(st.text("k", max_size=4), NUMBER)
            )
        }
    ),
)


@given(values=ENVELOPES, board=st.sampled_from(["strict", "lenient"]))
def test_the_carrier_takes_what_python_takes(boards: Boards, values: dict[str, Any], board: str) -> None:
    data = boards.envelope.message_class(**values).SerializeToString()
    boards.refusal(data, board)


@given(first=ENVELOPES, second=ENVELOPES, board=st.sampled_from(["strict", "lenient"]))
def test_also_of_two_payloads(boards: Boards, first: dict[str, Any], second: dict[str, Any], board: str) -> None:
    made = boards.envelope.message_class
    boards.refusal(made(**first).SerializeToString() + made(**second).SerializeToString(), board)


@given(data=st.binary(max_size=LONGEST))
def test_any_bytes_are_survived(boards: Boards, data: bytes) -> None:
    boards.carrier(data)
    boards.carrier(framed(TREE, data))
