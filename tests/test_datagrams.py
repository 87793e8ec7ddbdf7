from __future__ import annotations

from pathlib import Path

import pytest

from router.datagrams import Wire, framed, why_rejected, wire_of_protos
from router.errors import DecodeError, UsageError
from router.values.reading import payload
from tests.everything import unroutable, usual
from tests.everything import wire as wire_of_everything


@pytest.fixture(scope="module")
def wire() -> Wire:
    return wire_of_protos(Path(__file__).parent / "protos")


def test_an_envelope_comes_back_as_it_was_built(wire: Wire) -> None:
    case = wire.case("every_kind")
    message = payload(case, ["point.x=3", "text=hello"])
    decoded = wire.decode(wire.encode(case, message))
    assert (decoded.case, decoded.message, decoded.zeros) == (case, message, 0)


def test_an_empty_payload_is_still_a_payload(wire: Wire) -> None:
    case = wire.case("plain")
    assert wire.encode(case, payload(case, [])) == bytes.fromhex("1200")


def test_an_unknown_case_gets_the_nearest_name(wire: Wire) -> None:
    with pytest.raises(UsageError, match=r"PBEnvelope has no payload case 'plane'; did you mean 'plain'\?"):
        wire.case("plane")


@pytest.mark.parametrize(
    ("case", "words", "complaint"),
    [
        ("old", [], "old.Old requires needed; give needed a value"),
        (
            "old",
            ["motors[left].closed=CLOSED_ONE"],
            'old.Old requires needed and motors["left"].speed; give needed and motors["left"].speed a value',
        ),
    ],
)
def test_a_missing_required_field_is_named(case: str, words: list[str], complaint: str) -> None:
    everything = wire_of_everything()
    with pytest.raises(UsageError) as caught:
        everything.encode(everything.case(case), payload(everything.case(case), words))
    assert str(caught.value) == complaint


def test_the_envelopes_own_required_fields_stay_empty() -> None:
    everything = wire_of_everything()
    assert everything.encode(everything.case("empty"), payload(everything.case("empty"), [])) == b"\x3a\0"


@pytest.mark.parametrize("name", unroutable())
def test_a_member_that_is_no_message_is_unhandled(name: str) -> None:
    with pytest.raises(DecodeError, match=f"^unhandled: {name} is .*, not a message$"):
        wire_of_everything().decode(unroutable()[name])


def test_superseded_members_are_named_whatever_they_are() -> None:
    everything = wire_of_everything()
    data = b"".join(unroutable().values()) + usual()["at"]
    assert everything.decode(data).superseded == [*unroutable()]


def test_trimmed_and_padded_datagrams_are_repaired(wire: Wire) -> None:
    exact = wire.encode(wire.case("plain"), payload(wire.case("plain"), []))
    trimmed, padded = framed(exact, trim=True, pad=0), framed(exact, trim=True, pad=40)
    assert (trimmed.hex(), len(padded)) == ("12", 40)
    assert wire.decode(trimmed).zeros == 1
    assert wire.decode(padded).zeros == -38


def test_padding_never_cuts() -> None:
    with pytest.raises(UsageError, match="the datagram has 3 bytes and cannot be padded to 2"):
        framed(b"abc", trim=False, pad=2)


@pytest.mark.parametrize(
    ("datagram", "problem"),
    [
        ("", "empty"),
        ("ffff", "malformed: does not parse as PBEnvelope"),
        ("1a00", "unknown_case: field 3"),
        ("1001", "malformed: field 2 is not a message; it may be the payload 'every_kind' without its envelope"),
        ("0000", "no_payload"),
    ],
)
def test_what_cannot_be_decoded_says_why(wire: Wire, datagram: str, problem: str) -> None:
    with pytest.raises(DecodeError) as caught:
        wire.decode(bytes.fromhex(datagram))
    assert str(caught.value) == problem


ENVELOPE = bytes.fromhex("12050d0000803f")
ALONE = "send the envelope alone"


@pytest.mark.parametrize(
    ("datagram", "cause"),
    [
        (b"\x07" + ENVELOPE, f"a length (1 byte) precedes the envelope: {ALONE}"),
        (b"\x00\x07" + ENVELOPE, f"a length (2 bytes) precedes the envelope: {ALONE}"),
        (b"\x07\x00\x00\x00" + ENVELOPE, f"a length (4 bytes) precedes the envelope: {ALONE}"),
        (ENVELOPE + b"\x1f\x2f", f"2 bytes after the envelope look like a checksum: {ALONE}"),
        (ENVELOPE[2:], "it may be the payload 'plain' without its envelope"),
        (b'{"value": 1.0}', ""),
    ],
)
def test_what_firmware_does_with_an_envelope_is_recognised(wire: Wire, datagram: bytes, cause: str) -> None:
    with pytest.raises(DecodeError) as caught:
        wire.decode(datagram)
    told = why_rejected(wire.envelopes.first, datagram, len(datagram), repairs=True)
    assert (str(caught.value), told.partition("; ")[2]) == (f"malformed: {told}", cause)


def test_a_part_of_a_datagram_is_not_taken_for_another_one(wire: Wire) -> None:
    whole = ENVELOPE[2:] * 9
    assert why_rejected(wire.envelopes.first, whole[:5], len(whole), repairs=True) == "field 1 is not a message"


def test_a_datagram_that_the_router_would_not_take_is_not_decoded(wire: Wire) -> None:
    with pytest.raises(DecodeError, match="truncated: 20000 bytes"):
        wire.decode(b"\x12\x00" * 10_000)
