"""Files as others read them: Foxglove's own reader a finished one, and ours one whose writer was killed at any byte."""

from __future__ import annotations

import os
from pathlib import Path, PosixPath
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessages
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from router.errors import UsageError
from router.recording.channels import DATAGRAMS, Channels
from router.recording.encoder import Encoder, Packer
from router.recording.reader import Recording
from router.recording.writer import RecordingFile
from tests.recording.recorder_rig import (
    MILLISECOND,
    START,
    STRANGER,
    again,
    batched,
    imu,
    read,
    recorded,
    seen,
    wire,
    write,
)

SECOND = 1000 * MILLISECOND
BATCHES = (
    seen(imu(1), imu(2), b"no envelope", b""),
    seen(imu(3), imu(4).rstrip(b"\0") + bytes(3), imu(5), at=START + SECOND, peer=STRANGER),
    seen(imu(6), at=START + 2 * SECOND),
)


def foxglove(path: Path) -> list[tuple[str, Any, Message]]:
    """Topic, decoded message and record of all there is, with nothing of ours and no `.proto` file."""
    with path.open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages())
    return [(channel.topic, decoded(schema, message), message) for schema, channel, message in found]


def decoded(schema: Schema | None, message: Message) -> Any:
    assert schema is not None
    assert schema.encoding == "protobuf"
    files = FileDescriptorSet.FromString(schema.data)
    return GetMessages(files.file)[schema.name].FromString(message.data)


def test_foxglove_reads_fields_by_their_names_with_the_time_of_arrival(tmp_path: Path) -> None:
    found = foxglove(recorded(tmp_path / "it.mcap", *BATCHES))
    readings = [(message.log_time, told.accel_x) for topic, told, message in found if topic == "imu_info"]
    assert readings == [
        (START, 1),
        (START + MILLISECOND, 2),
        (START + SECOND, 3),
        (START + SECOND + MILLISECOND, 4),  # which came with other zeros than it was sent with
        (START + SECOND + 2 * MILLISECOND, 5),
        (START + 2 * SECOND, 6),
    ]


def test_foxglove_reads_what_was_no_payload_as_bytes_with_who_sent_it(tmp_path: Path) -> None:
    found = foxglove(recorded(tmp_path / "it.mcap", *BATCHES))
    raw = [(told.listener, told.peer, told.endpoint, told.data) for topic, told, _ in found if topic == DATAGRAMS]
    assert raw[0] == ("rover", "10.0.0.3:5000", "sensor_board", b"no envelope")
    assert raw[1] == ("rover", "10.0.0.3:5000", "sensor_board", b"")
    assert raw[2][:3] == ("rover", "10.9.9.9:40000", "")


def test_what_no_decoder_takes_is_under_no_payload_case(tmp_path: Path) -> None:
    bad = imu()[:2] + b"\xff" * (len(imu()) - 2)
    found = foxglove(recorded(tmp_path / "it.mcap", seen(imu(), bad, imu())))
    assert [topic for topic, _, _ in found] == ["imu_info", DATAGRAMS, "imu_info"]


def test_every_reader_finds_the_same_and_can_seek(tmp_path: Path) -> None:
    path = recorded(tmp_path / "it.mcap", *BATCHES)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    with path.open("rb") as file:
        from_start = [message for _, _, message in NonSeekingReader(file, validate_crcs=True).iter_messages()]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(from_start) == len(foxglove(path))
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (START, START + 2 * SECOND)
    assert [index.message_start_time for index in summary.chunk_indexes] == [START, START + SECOND, START + 2 * SECOND]
    with path.open("rb") as file:
        for index in summary.chunk_indexes:  # what Foxglove seeks by
            for channel, offset in index.message_index_offsets.items():
                file.seek(offset)
                assert file.read(1) == b"\x07"
                assert int.from_bytes(file.read(10)[8:], "little") == channel


def test_the_order_of_what_foxglove_shows_is_that_of_arrival(tmp_path: Path) -> None:
    channels: dict[int, Channel] = {}
    with recorded(tmp_path / "it.mcap", *BATCHES).open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            channels[message.sequence] = channel
    assert list(channels) == list(range(1, 9))


@pytest.mark.parametrize("finish", [True, False])
def test_a_kill_at_any_byte_leaves_all_chunks_that_were_written_whole(finish: bool, tmp_path: Path) -> None:
    """At each byte around the ends of records, and at every eleventh of all others."""
    path = recorded(tmp_path / "it.mcap", *BATCHES, finish=finish)
    whole = path.read_bytes()
    with recorded(tmp_path / "other.mcap", *BATCHES).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    # a chunk counts without its index
    ends = [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]
    begun = summary.chunk_indexes[0].chunk_start_offset
    cut = tmp_path / "cut.mcap"
    sizes = {begun + at for at in range(0, len(whole) - begun, 11)}
    sizes |= {end + beside for end in (begun, *ends, len(whole) - 8) for beside in range(-12, 13)}
    for size in sorted(size for size in sizes if begun <= size <= len(whole)):
        cut.write_bytes(whole[:size])
        expected = [each for batch, end in zip(BATCHES, ends, strict=True) if end <= size for each in batch]
        recording = Recording(cut)
        assert [again(each) for each in recording.datagrams()] == expected
        assert recording.is_whole == (finish and size >= len(whole) - 8)


@pytest.mark.parametrize("tail", [bytes(5000), b"\xff" * 5000, b"\x06" + b"\x10" + bytes(4000)])
def test_what_a_loss_of_power_leaves_behind_is_not_read(tail: bytes, tmp_path: Path) -> None:
    path = recorded(tmp_path / "it.mcap", *BATCHES, finish=False)
    with path.open("ab") as file:
        file.write(tail)
    assert [again(each) for each in read(path)] == [each for batch in BATCHES for each in batch]


def test_a_damaged_chunk_ends_what_is_read(tmp_path: Path) -> None:
    path = recorded(tmp_path / "it.mcap", *BATCHES)
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    data[summary.chunk_indexes[1].chunk_start_offset + 60] ^= 0xFF
    path.write_bytes(data)
    assert [again(each) for each in read(path)] == list(BATCHES[0])


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"", "is not an MCAP file"), (b"version: 1", "is not an MCAP file"), (None, "No such file or directory")],
)
def test_what_is_no_recording_is_refused(content: bytes | None, said: str, tmp_path: Path) -> None:
    path = tmp_path / "it.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UsageError, match=said):
        Recording(path)


class _RemovedOnceOpen(PosixPath):
    """A file that the router removes, to make room, as soon as somebody has opened it."""

    def open(self, *arguments: Any, **options: Any) -> Any:
        opened = super().open(*arguments, **options)
        self.unlink()
        return opened


def test_a_recording_that_is_removed_while_it_is_opened_is_still_read(tmp_path: Path) -> None:
    path = recorded(tmp_path / "it.mcap", *BATCHES)
    found = Recording(_RemovedOnceOpen(path))
    assert len([*found.datagrams()]) == sum(map(len, BATCHES))
    assert not path.exists()


def test_mcap_of_somebody_else_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "it.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("camera", "json", 0, {"holds": "pictures"})
        writer.add_metadata("camera", {})
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()  # type: ignore[no-untyped-call]  # of mcap
    with pytest.raises(UsageError, match="is not a recording of a router"):
        Recording(tmp_path / "it.mcap")


def rewritten(path: Path, metadata: str, compression: CompressionType) -> Path:
    """Write a recording anew as other tools do: schemas and channels move into chunks, the header names the tool.

    `mcap filter`, `compress` and `recover` keep the metadata `before` the messages unless told otherwise; their
    predecessors put it `after` or left it `out`.
    """
    made = path.with_name("rewritten.mcap")
    with path.open("rb") as source, made.open("wb") as file:
        reader, writer = make_reader(source), Writer(file, chunk_size=100, compression=compression)
        writer.start(library="mcap-cli 1.0")
        notes = [(each.name, each.metadata) for each in reader.iter_metadata()]
        assert notes
        if metadata == "before":
            for note in notes:
                writer.add_metadata(*note)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        if metadata == "after":
            for note in notes:
                writer.add_metadata(*note)
        writer.finish()  # type: ignore[no-untyped-call]  # of mcap
    return made


@pytest.mark.parametrize("compression", [*CompressionType])
@pytest.mark.parametrize("metadata", ["before", "after", "out"])
def test_a_recording_that_another_tool_rewrote_is_read_like_the_first(
    metadata: str, compression: CompressionType, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "it.mcap", *BATCHES)
    first, second = Recording(path), Recording(rewritten(path, metadata, compression))
    assert [*second.datagrams()] == [*first.datagrams()]
    assert second.types() == first.types() != ([], {})
    assert second.about == ({} if metadata == "out" else first.about)
    assert second.is_whole


def test_what_the_disk_took_in_part_is_cut_off_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    channels, packer = Channels(), Packer()
    file, encoder = RecordingFile(tmp_path / "it.mcap", channels, {}), Encoder(channels)
    file.write(encoder.messages(batched(packer, BATCHES[0])))
    size, real = file.size, os.write

    def full(descriptor: int, data: bytes) -> int:
        if os.fstat(descriptor).st_size > size:
            raise OSError(28, "No space left on device")
        return real(descriptor, data[:40])

    with monkeypatch.context() as failing:
        failing.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space"):
            file.write(encoder.messages(batched(packer, BATCHES[1])))
    assert file.size == size == (tmp_path / "it.mcap").stat().st_size
    file.close()
    assert [again(each) for each in read(tmp_path / "it.mcap")] == BATCHES[0]


def test_channels_are_written_only_into_files_that_use_them(tmp_path: Path) -> None:
    channels, packer = Channels(), Packer()
    for name, batch in (("first.mcap", BATCHES[0]), ("second.mcap", BATCHES[2])):
        write(tmp_path / name, channels, batched(packer, batch))
    with (tmp_path / "second.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert [channel.topic for channel in summary.channels.values()] == ["imu_info"]
    assert [schema.name for schema in summary.schemas.values()] == [
        wire().case("imu_info").message_class.DESCRIPTOR.full_name
    ]
