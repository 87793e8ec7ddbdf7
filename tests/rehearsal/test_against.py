"""`router replay FILE --against NEW`: what two tables make of one recording, as a person reads it."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.cli import main
from router.recording.mirror import MirroredDatagram
from router.recording.reader import Recording
from router.rehearsal.against import Against
from tests.recording.recorder_rig import MILLISECOND, START, imu, recorded, seen, wire
from tests.small_tables import BASESTATION, HEAD, SENSOR_BOARD, program
from tests.tables import PROTOS

FORWARD = "  imu_info: {source: sensor_board, destinations: [basestation]}\n"
TOPIC = """\
  imu_info:
    source: sensor_board
    topics:
      - topic: imu
        type: sensor_msgs/msg/Imu
        fields: {header: {stamp: received_at}, linear_acceleration: {x: FIELD}}
"""
LISTENER = "trimmed"


def brake() -> bytes:
    case = wire().case("manual_brake")
    return wire().encode(case, case.message_class(brake=True))


def batches() -> list[list[MirroredDatagram]]:
    return [
        [each._replace(listener=LISTENER) for each in seen(*datagrams, at=at, peer=peer)]
        for datagrams, at, peer in (
            ([imu(number) for number in (1, 2, 3)], START, SENSOR_BOARD),
            ([brake()], START + 400 * MILLISECOND, BASESTATION),
            ([imu(7)], START + 500 * MILLISECOND, ("192.168.0.99", 1234)),
        )
    ]


class Compared:
    """Exit code and lines of a comparison of two tables whose routes are these."""

    def __init__(
        self,
        folder: Path,
        old: str,
        new: str,
        capsys: pytest.CaptureFixture[str],
        new_head: str = HEAD,
        old_head: str = HEAD,
    ) -> None:
        recorded(folder / "it.mcap", *batches())
        for name, text in (("old", old_head + old), ("new", new_head + new)):
            (folder / f"{name}.yaml").write_text(text.replace("PROTOS", str(PROTOS)))
        words = [str(folder / "it.mcap"), "--table", str(folder / "old.yaml"), "--against", str(folder / "new.yaml")]
        self.code = main(["replay", *words])
        captured = capsys.readouterr()
        self.lines = captured.out.splitlines()
        self.err = captured.err

    def row(self, route: str, target: str) -> dict[str, int]:
        names = next(line for line in self.lines if line.startswith("route ")).split()[2:]
        words = next(line for line in self.lines if line.split()[:2] == [route, target]).split()[2:]
        return {name: int(word) for name, word in zip(names, words, strict=True) if int(word)}


def test_the_same_table_delivers_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = Compared(tmp_path, FORWARD, FORWARD, capsys)
    assert found.code == 0
    assert found.lines[0].startswith("5 datagrams of 0.5 s, through ")
    assert found.lines[1:] == [
        "both deliver the same, 3 datagrams and messages",
        "rejected (source_mismatch): 1 with both",
        "rejected (unhandled): 1 with both",
    ]


@pytest.mark.parametrize("new", [FORWARD, FORWARD.replace("sensor_board", "any")])
def test_tables_for_another_network_are_told_as_such(
    new: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of strangers both deliver the same, which is nothing, and which says nothing of the tables."""
    elsewhere = HEAD.replace("192.168.0.", "10.1.1.")
    found = Compared(tmp_path, FORWARD, new, capsys, elsewhere, elsewhere)
    assert found.code == (new != FORWARD)
    senders = ", ".join(f"a stranger at 192.168.0.{number}" for number in (10, 30, 99))
    assert found.lines[-2:] == [
        f"neither table has an endpoint for any sender of the recording: {senders};",
        "compare tables with the addresses of the recording",
    ]


def test_where_one_table_knows_the_senders_no_other_network_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = Compared(tmp_path, FORWARD, FORWARD, capsys, HEAD.replace("192.168.0.", "10.1.1."))
    assert found.code == 1
    assert not any("came from:" in line for line in found.lines)


def test_host_names_have_the_addresses_of_the_recording(tmp_path: Path) -> None:
    named = program(tmp_path, FORWARD, HEAD.replace("192.168.0.30:8", "board.local:8"))
    against = Against(program(tmp_path, FORWARD), named)
    for found in Recording(recorded(tmp_path / "it.mcap", *batches())).datagrams():
        against.take(found._replace(endpoint="sensor_board" if found.peer == SENSOR_BOARD else ""))
    assert not against.differs
    assert against.rows["imu_info", "basestation"].same == 3


def test_a_changed_mapping_is_told_field_by_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = Compared(tmp_path, TOPIC.replace("FIELD", "accel_x"), TOPIC.replace("FIELD", "2 * accel_x"), capsys)
    assert found.code == 1
    assert found.row("imu_info", "imu") == {"old": 3, "new": 3, "changed": 3}
    at = found.lines.index("imu_info to imu, 0.000 s after the beginning:")
    assert found.lines[at + 1 :] == ["  linear_acceleration.x: 1.0 became 2.0"]  # one example is enough


def test_what_only_one_table_delivers_is_told_with_its_content(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = FORWARD + "  manual_brake: {source: basestation, destinations: [recorder]}\n"
    found = Compared(tmp_path, FORWARD.replace("basestation", "recorder"), more, capsys)
    assert found.row("imu_info", "recorder") == {"old": 3, "lost": 3}
    assert found.row("imu_info", "basestation") == {"new": 3, "added": 3}
    assert found.row("manual_brake", "recorder") == {"new": 1, "added": 1}
    assert "  with the new table only: manual_brake brake=true" in found.lines
    assert "rejected (unhandled): trimmed: 1 with the old table, 0 with the new one" in found.lines


def test_losses_are_told_with_their_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slow = FORWARD.replace("[basestation]", "[{endpoint: basestation, max_rate: 1 Hz}]")
    found = Compared(tmp_path, FORWARD, slow, capsys)
    assert found.row("imu_info", "basestation") == {"old": 3, "new": 1, "same": 1, "lost": 2}
    assert "dropped (rate_limited): imu_info to basestation: 0 with the old table, 2 with the new one" in found.lines


def test_what_comes_later_is_not_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A destination with a budget gets the same, at other times."""
    late = FORWARD.replace("[basestation]", "[{endpoint: basestation, max_rate: 100 Hz, on_limit: latest}]")
    found = Compared(tmp_path, FORWARD, late, capsys)
    row = found.row("imu_info", "basestation")
    assert row["moved"] == 1  # the third, when the first was 10 ms ago
    assert row == {"old": 3, "new": 2, "same": 1, "moved": 1, "lost": 1}


def test_a_listener_that_one_table_lacks_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = Compared(tmp_path, FORWARD, FORWARD, capsys, HEAD.replace("trimmed:", "other:"))
    assert found.code == 1
    assert any("rejected (no such listener): trimmed: 0 with the old" in line for line in found.lines)


def test_a_bad_table_is_told_as_validate_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = Compared(tmp_path, FORWARD, FORWARD.replace("sensor_board", "sensor_bord"), capsys)
    assert found.code == 78
    assert "unknown-endpoint" in found.err


def test_comparing_and_sending_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "it.mcap", "--against", "new.yaml", "--speed", "2x"]) == 2
    assert "--against sends nothing" in capsys.readouterr().err


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 60)), min_size=1, max_size=20), st.data())
def test_rows_add_up_whatever_comes(steps: list[tuple[int, int]], data: st.DataObject) -> None:
    """Old and new are what was the same, changed, moved, and only there; and nothing is below zero."""
    forms = [
        FORWARD,
        FORWARD.replace("[basestation]", "[{endpoint: basestation, max_rate: 50 Hz}]"),
        FORWARD.replace("[basestation]", "[{endpoint: basestation, max_rate: 50 Hz, on_limit: latest}]"),
        FORWARD.replace("[basestation]", "[{endpoint: basestation, when: accel_x > 1}, recorder]"),
    ]
    old, new = (data.draw(st.sampled_from(forms)) for _ in range(2))
    at, shown = START, []
    for value, passed in steps:
        at += passed * MILLISECOND
        shown += [each._replace(listener=LISTENER) for each in seen(imu(value), at=at, peer=SENSOR_BOARD)]
    with tempfile.TemporaryDirectory() as folder:
        for name in ("old", "new"):
            (Path(folder) / name).mkdir()
        against = Against(program(Path(folder) / "old", old), program(Path(folder) / "new", new))
        for found in Recording(recorded(Path(folder) / "it.mcap", shown)).datagrams():
            against.take(found)
    assert against.differs <= (old != new)
    for row in against.rows.values():
        assert min(row.same, row.changed, row.moved, row.lost, row.added) >= 0
        assert row.same + row.changed + row.moved + row.lost == row.old
        assert row.same + row.changed + row.moved + row.added == row.new


LINE = "  uart: {serial: /dev/ttyAMA0, baud: 9600, framing: cobs}\n"
ON_LINE_HEAD = re.sub("sensor_board: {address: [^,]*", "sensor_board: {listener: uart", HEAD).replace(
    "endpoints:\n", f"{LINE}endpoints:\n"
)


@pytest.mark.parametrize("heads", [(HEAD, ON_LINE_HEAD), (ON_LINE_HEAD, HEAD), (ON_LINE_HEAD, ON_LINE_HEAD)])
@pytest.mark.parametrize("place", [(LISTENER, SENSOR_BOARD), ("uart", ("0.0.0.0", 0))])
def test_a_board_may_be_at_a_serial_line_in_one_table_and_in_the_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], heads: tuple[str, str], place: tuple[str, tuple[str, int]]
) -> None:
    listener, peer = place
    frames = [each._replace(listener=listener, endpoint="sensor_board") for each in seen(imu(1), imu(2), peer=peer)]
    recorded(tmp_path / "it.mcap", frames)
    old, new = tmp_path / "old.yaml", tmp_path / "new.yaml"
    for path, head in zip((old, new), heads, strict=True):
        path.write_text((head + FORWARD).replace("PROTOS", str(PROTOS)))
    assert main(["replay", str(tmp_path / "it.mcap"), "--table", str(old), "--against", str(new)]) == 0
    assert "both deliver the same, 2 datagrams and messages" in capsys.readouterr().out
