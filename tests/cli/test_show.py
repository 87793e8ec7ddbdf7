"""`router show`: what is printed of a recording, and why a robot stopped according to it."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from datetime import datetime, timezone
from pathlib import Path
from types import MappingProxyType

import pytest

from router.cli import main
from router.cli.show import in_order, window
from router.errors import UsageError
from router.recording.about import RecordedRoute
from router.recording.channels import Channels
from router.recording.encoder import Encoder, Packer
from router.recording.mirror import BRAKED, FED, LOST, RELEASED, RETURNED, SENT, TRIPPED, Action, MirroredDatagram
from router.recording.reader import Recording
from router.recording.writer import RecordingFile
from tests.recording.recorder_rig import MILLISECOND, SENSOR_BOARD, batched, shown, wire

JUNK = "malformed: does not parse as rover_router.Recorded"
CHECK = "Check its power, cable or radio, and address: `ping 10.0.0.7`, `tcpdump -n udp and host 10.0.0.7`."
BASESTATION = ("10.0.0.7", 5000)
BEGIN = int(datetime(2026, 4, 12, 14, 2, 30, tzinfo=timezone.utc).timestamp()) * 10**9
ROUTES = {
    "manual_drive": RecordedRoute("manual_drive", ["basestation"], False, 500.0, ["driving_board"])._asdict(),
    "drive_motor": RecordedRoute("drive_motor", ["cmd"], True, 500.0, ["driving_board"])._asdict(),
    "imu_info": RecordedRoute("imu_info", ["sensor_board"], False, 0.0, [])._asdict(),
}


@pytest.fixture(autouse=True)
def _zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Two hours ahead of UTC."""
    with monkeypatch.context() as changed:
        changed.setitem(os.environ, "TZ", "XXX-2")
        time.tzset()
        yield
    time.tzset()


def datagram(case: str, **fields: object) -> bytes:
    found = wire().case(case)
    return wire().encode(found, found.message_class(**fields))


DRIVE, BRAKE, IMU = (
    datagram("manual_drive", forward_backward=5),
    datagram("manual_brake", brake=True),
    datagram("imu_info"),
)


def at(seconds: float) -> int:
    return BEGIN + round(seconds * 1000) * MILLISECOND


def got(seconds: float, data: bytes, sender: str = "basestation", reason: str = "") -> MirroredDatagram:
    peer = {"basestation": BASESTATION, "sensor_board": SENSOR_BOARD}.get(sender, (sender, 4000))
    return shown(data, at(seconds), peer, reason=reason)._replace(endpoint=sender if sender[0].isalpha() else "")


def did(seconds: float, what: str, route: str = "manual_drive", **more: object) -> Action:
    return Action(at(seconds), what, route, **more)  # type: ignore[arg-type]


def driven(*seconds: float) -> list[MirroredDatagram | Action]:
    return [
        each
        for second in seconds
        for each in (got(second, DRIVE), did(second + 0.001, SENT, target="driving_board", data=DRIVE))
    ]


def stopped(second: float, route: str = "manual_drive") -> list[Action]:
    brakes = [did(second + 0.1 * turn, BRAKED, route, target="driving_board", data=BRAKE) for turn in range(3)]
    return [did(second, TRIPPED, route), *brakes]


def recording(
    folder: Path,
    *entries: MirroredDatagram | Action,
    routes: object = ROUTES,
    tripped: object = (),
    more: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """A recording as the recorder makes it: batches of 50 ms, actions after datagrams."""
    path = folder / "it.mcap"
    channels = Channels()
    about = {"reason": "test", "table": "rover.yaml", "routes": json.dumps(routes), **more}
    file = RecordingFile(path, channels, {**about, "tripped": json.dumps(tripped)} if tripped else about)
    packer, encoder = Packer(), Encoder(channels)
    batches: dict[int, list[MirroredDatagram | Action]] = {}
    for each in entries:
        batches.setdefault(each.at // (50 * MILLISECOND), []).append(each)
    for batch in (batches[number] for number in sorted(batches)):
        clocks = batch[-1].at, batch[-1].at - BEGIN
        datagrams = [each for each in batch if isinstance(each, MirroredDatagram)]
        actions = [each for each in batch if isinstance(each, Action)]
        file.write(encoder.messages(batched(packer, datagrams, actions, clocks)))
    file.close()
    return str(path)


def said(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    assert main(["show", *words]) == 0
    return capsys.readouterr().out.splitlines()


def test_everything_is_printed_in_the_order_of_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(
        tmp_path,
        did(0, BRAKED, target="driving_board", data=BRAKE),
        *driven(0.01),
        got(0.02, IMU, "sensor_board"),
        got(0.03, DRIVE, "10.9.9.9", "source_mismatch"),
        got(0.04, b"junk", "sensor_board", "malformed"),
        did(0.2, LOST, "drive_motor", target="driving_board", topic="cmd", reason="stale", detail="sent 2 s ago"),
        did(0.3, SENT, "drive_motor", target="driving_board", topic="cmd", data=datagram("drive_motor")),
        *stopped(0.5)[:2],
        did(0.6, BRAKED, target="driving_board", reason="send_error", detail="Network is unreachable", data=BRAKE),
        did(0.7, RELEASED),
        tripped=["manual_drive"],
    )
    assert main(["show", path]) == 0
    captured = capsys.readouterr()
    assert captured.err == (
        f"{path}: saved because of manual_drive, table rover.yaml; begins 2026-04-12 16:02:30.000, local time "
        "(UTC+02:00)\n"
    )
    assert captured.out.splitlines() == [
        "16:02:30.000+0200 sent to driving_board (the deadman of manual_drive): manual_brake brake=true",
        "16:02:30.010+0200 basestation manual_drive forward_backward=5",
        "16:02:30.011+0200 sent to driving_board (manual_drive): manual_drive forward_backward=5",
        "16:02:30.020+0200 sensor_board imu_info (all default)",
        "16:02:30.030+0200 10.9.9.9:4000 rejected (source_mismatch) manual_drive forward_backward=5",
        f"16:02:30.040+0200 sensor_board rejected (malformed) undecodable ({JUNK}): 6a756e6b",
        "16:02:30.200+0200 not sent to driving_board (drive_motor from topic cmd): stale: sent 2 s ago",
        "16:02:30.300+0200 sent to driving_board (drive_motor from topic cmd): drive_motor (all default)",
        "16:02:30.500+0200 the deadman of manual_drive tripped",
        "16:02:30.500+0200 sent to driving_board (the deadman of manual_drive): manual_brake brake=true",
        "16:02:30.600+0200 not sent to driving_board (the deadman of manual_drive): send_error: Network is unreachable",
        "16:02:30.700+0200 the deadman of manual_drive was released: a command was sent",
    ]


def test_cases_conditions_and_times_choose_what_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(tmp_path, *driven(0, 40, 100), got(1, IMU, "sensor_board"), *stopped(101))
    assert len(said(capsys, path, "--case", "manual_drive")) == 6
    assert [line.split()[0] for line in said(capsys, path, "--case", "imu_info", "--case", "manual_brake")] == [
        "16:02:31.000+0200", "16:04:11.000+0200", "16:04:11.100+0200", "16:04:11.200+0200",
    ]  # fmt: skip
    assert len(said(capsys, path, "--where", "forward_backward > 4")) == 6
    assert len(said(capsys, path, "--where", "brake")) == 3
    assert len(said(capsys, path, "--around", "16:02:30", "--margin", "1s")) == 3
    assert said(capsys, path, "--around", "16:02")[0].startswith("16:02:30.000")
    assert len(said(capsys, path, "--around", "2026-04-12T14:04:10Z", "--margin", "1s")) == 6
    assert main(["show", path, "--around", "17:00"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "nothing to show between 16:59:30.000 and 17:01:30.000; the recording ends at 16:04:11.200" in captured.err


def test_json_has_one_object_for_each_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(tmp_path, *driven(0), *stopped(0.5))
    received, sent, tripped, *_ = map(json.loads, said(capsys, path, "--json"))
    assert (received["case"], received["peer"], received["time"]) == (
        "manual_drive", "basestation", "2026-04-12T14:02:30+00:00",
    )  # fmt: skip
    assert sent == {
        "time": "2026-04-12T14:02:30.001000+00:00",
        "action": "sent",
        "route": "manual_drive",
        "endpoint": "driving_board",
        "case": "manual_drive",
        "fields": {"forward_backward": 5},
    }
    assert tripped == {"time": "2026-04-12T14:02:30.500000+00:00", "action": "tripped", "route": "manual_drive"}


def explained(capsys: pytest.CaptureFixture[str], path: str) -> list[str]:
    return said(capsys, path, "--why")


def test_a_lost_link_is_the_cause_when_the_sender_is_silent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(
        tmp_path, *driven(0, 1), *stopped(1.501), *driven(3.801), did(3.802, RELEASED), got(4, IMU, "sensor_board")
    )
    assert explained(capsys, path) == [
        "16:02:31.501 the deadman of manual_drive tripped and braked driving_board, 500 ms after the last command",
        "  cause     basestation was silent from 16:02:31.000 until 16:02:33.801 (2.80 s)",
        f"  remedy    {CHECK}",
        "  last fed  16:02:31.001 by manual_drive from basestation: forward_backward=5",
        "  sent      manual_brake to driving_board, 3 times",
        "  board     driving_board was not heard before the stop, and not after it",
        "  released  16:02:33.802, after 2.30 s",
    ]


def test_an_operator_who_sends_other_messages_is_not_silent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    others = [got(0.1 * turn, IMU, "basestation") for turn in range(30)]
    lines = explained(capsys, recording(tmp_path, *driven(0), *others[:6], *stopped(0.501), *others[6:]))
    assert lines[1] == "  cause     basestation was heard until 16:02:30.500, but sent no manual_drive"
    assert not any("remedy" in line for line in lines)


def test_rejected_commands_are_the_cause_and_their_senders_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rejected = [got(1.02 + 0.02 * turn, DRIVE, "10.9.9.9", "source_mismatch") for turn in range(20)]
    earlier = got(0.5, DRIVE, "10.8.8.8", "source_mismatch")
    lines = explained(capsys, recording(tmp_path, earlier, *driven(1), *rejected, *stopped(1.501)))
    assert lines[1] == (
        "  cause     20 manual_drive from 10.9.9.9 were rejected: source_mismatch; "
        "basestation was silent from 16:02:31.000 until the end of the recording"
    )
    assert "No route accepts them from that address" in lines[2]
    assert [line for line in lines if "lost" in line] == [
        "  lost      20 manual_drive from 10.9.9.9 were rejected: source_mismatch, 16:02:31.020 to 16:02:31.400"
    ]


def test_dropped_commands_are_the_cause_for_datagrams_and_messages_from_ros(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stale = {"target": "driving_board", "reason": "stale"}
    path = recording(
        tmp_path,
        *driven(0),
        got(0.2, DRIVE),
        did(0.201, LOST, detail="sent 5 s ago by the publisher's clock, but ttl is 200 ms", **stale),
        *stopped(0.501),
        did(1, LOST, "drive_motor", topic="cmd", **stale),
        *stopped(1.5, "drive_motor"),
    )
    first, second = "\n".join(explained(capsys, path)).split("\n\n")
    assert "cause     1 manual_drive from basestation was dropped: stale\n" in first
    assert "16:02:30.201 (sent 5 s ago by the publisher's clock, but ttl is 200 ms)" in first
    assert "cause     1 drive_motor from topic cmd was dropped: stale\n" in second
    assert "last fed  never since 16:02:30.000, where the recording begins; the one before it may show it" in second


def test_a_topic_without_messages_is_the_cause(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fed = did(0.2, SENT, "drive_motor", target="driving_board", topic="cmd", data=datagram("drive_motor"))
    lines = explained(capsys, recording(tmp_path, got(0, IMU, "sensor_board"), fed, *stopped(0.7, "drive_motor")))
    assert lines[1] == "  cause     no message arrived on cmd"
    assert "  last fed  16:02:30.200 by drive_motor from topic cmd: (all default)" in lines


def test_a_board_that_was_silent_is_told_with_and_without_a_stop(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    back = Action(at(2.4), RETURNED, "", "driving_board", detail="2.3 s")
    path = recording(
        tmp_path, got(0.1, IMU, "driving_board"), *driven(0.2), *stopped(0.701), got(2.4, IMU, "driving_board"), back
    )
    lines = explained(capsys, path)
    assert "  board     driving_board was last heard 601 ms before the stop, and 1.70 s after it" in lines
    assert lines[-1] == "16:02:32.400+0200 driving_board was silent for 2.3 s and is back"
    (calm := tmp_path / "calm").mkdir()
    path = recording(calm, back)
    assert explained(capsys, path) == lines[-1:]
    [line] = said(capsys, path, "--why", "--json")
    assert json.loads(line) == {
        "time": "2026-04-12T14:02:32.400000+00:00",
        "action": "returned",
        "endpoint": "driving_board",
        "detail": "2.3 s",
    }


def test_the_deadman_of_a_gateways_client_tells_when_a_client_fed_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    route = "dashboard:/cmd_vel"
    path = recording(tmp_path, *(did(0.1 * turn, FED, route) for turn in range(3)), did(0.7, TRIPPED, route))
    assert explained(capsys, path) == [
        f"16:02:30.700 the deadman of {route} tripped, 500 ms after the last command",
        "  cause     no client published on /cmd_vel",
        "  remedy    Check that the client runs and reaches the gateway.",
        "  last fed  16:02:30.200 by a client's message",
        "  sent      its message on /cmd_vel, which is not recorded",
        "  released  not in this recording",
    ]
    assert said(capsys, path)[0] == f"16:02:30.000+0200 the deadman of {route} was fed by a client's message"


def test_losses_are_told_beside_deadmen_that_the_metadata_does_not_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of gateways' clients, and all if a tool left the metadata out."""
    rejected = got(0.1, DRIVE, "sensor_board", "source_mismatch")
    path = recording(tmp_path, *stopped(0, "dashboard:/cmd_vel"), rejected, *stopped(0.5))
    assert [line for line in explained(capsys, path) if "lost" in line] == [
        "  lost      1 manual_drive from sensor_board was rejected: source_mismatch, 16:02:30.100"
    ]
    lost = did(0.3, LOST, target="driving_board", reason="stale")
    (tmp_path / "without").mkdir()
    path = recording(tmp_path / "without", *stopped(0), rejected, lost, *stopped(0.5), routes={})
    assert [line for line in explained(capsys, path) if "lost" in line] == [
        "  lost      1 datagram was dropped: stale, 16:02:30.300"
    ]


def test_only_the_stops_around_a_time_are_explained_and_their_absence_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path, *driven(0), *stopped(0.5), did(1, RELEASED), *driven(300), *stopped(300.5))
    assert len("\n".join(said(capsys, path, "--why")).split("\n\n")) == 2
    [line, *_] = said(capsys, path, "--why", "--around", "16:07")
    assert line.startswith("16:07:30.500 the deadman")
    assert main(["show", path, "--why", "--around", "16:05"]) == 0
    assert "no deadman tripped between 16:04:30.000 and 16:06:30.000" in capsys.readouterr().err


def test_a_stop_is_also_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rejected = got(0.1, DRIVE, "10.9.9.9", "source_mismatch")
    [line] = said(capsys, recording(tmp_path, *driven(0), rejected, *stopped(0.5)), "--why", "--json")
    found = json.loads(line)
    assert (found["time"], found["route"], found["stopped"], found["released"]) == (
        "2026-04-12T14:02:30.500000+00:00", "manual_drive", ["driving_board"], None,
    )  # fmt: skip
    assert found["last_fed"] == {
        "time": "2026-04-12T14:02:30.001000+00:00", "case": "manual_drive", "sender": "basestation",
    }  # fmt: skip
    assert found["lost"] == [
        {
            "decision": "rejected",
            "reason": "source_mismatch",
            "case": "manual_drive",
            "sender": "10.9.9.9",
            "count": 1,
            "detail": "",
        }
    ]
    assert found["sent"] == [{"case": "manual_brake", "endpoint": "driving_board", "problem": "", "count": 3}]


def test_a_stop_tells_which_boards_have_shown_that_they_obey(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = "manual_drive: driving_board stopped after 0.43 s; manual_drive: arm_board did not obey for 2.00 s"
    path = recording(tmp_path, *driven(0), *stopped(0.5), more={"obeyed": answers})
    assert [line for line in explained(capsys, path) if "obeyed" in line] == [
        "  obeyed    driving_board stopped after 0.43 s",
        "  obeyed    arm_board did not obey for 2.00 s",
    ]


def test_a_recording_of_an_earlier_version_says_what_it_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path, got(0, IMU, "sensor_board"), routes={})
    assert main(["show", path, "--why"]) == 0
    assert "has no actions of the router" in capsys.readouterr().err


def test_actions_are_not_replayed(tmp_path: Path) -> None:
    with closing(Recording(Path(recording(tmp_path, *driven(0, 1), *stopped(2))))) as found:
        assert [each.data for each in found.datagrams()] == [DRIVE, DRIVE]


def test_what_the_recorder_wrote_is_put_in_order(tmp_path: Path) -> None:
    path = recording(tmp_path, *driven(0, 0.01, 0.02))
    with closing(Recording(Path(path))) as found:
        times = [each.at for each in found.everything()]
    assert times != sorted(times)
    with closing(Recording(Path(path))) as found:
        assert [each.at for each in in_order(found.everything())] == sorted(times)


def test_a_time_of_day_is_the_next_one_after_the_beginning() -> None:
    minute = 60 * 10**9
    begin = int(datetime(2026, 4, 12, 21, 59, 50, tzinfo=timezone.utc).timestamp()) * 10**9  # 23:59:50 here
    assert window("23:59", 0, begin) == (begin - 50 * 10**9, begin + 10 * 10**9)
    assert window("00:03", 0, begin) == (begin + 10 * 10**9 + 3 * minute, begin + 10 * 10**9 + 4 * minute)
    assert window("00:03:07.5", 1, begin)[0] == begin + 10 * 10**9 + 3 * minute + 6 * 10**9


@pytest.mark.parametrize("wrong", ["14", "25:00", "yesterday", "2026-13-01T10:00"])
def test_what_is_no_time_is_refused(wrong: str) -> None:
    with pytest.raises(UsageError, match=re.escape(f"--around: '{wrong}' is not a time")):
        window(wrong, 0, BEGIN)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--why", "--case", "imu_info"], "--why explains whole stops"),
        (["--margin", "1s"], "--margin is for --around"),
        (["--case", "imu_inf"], "did you mean 'imu_info'"),
        (["--where", "nothing > 1"], "--where: "),
    ],
)
def test_words_that_do_not_fit_are_told(
    words: list[str], what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", recording(tmp_path, got(0, IMU, "sensor_board")), *words]) == 2
    assert what in capsys.readouterr().err
