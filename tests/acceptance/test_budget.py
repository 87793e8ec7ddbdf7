"""Commands and more bulk than a budget allows, on their way to one board."""

from __future__ import annotations

from pathlib import Path
from time import monotonic, sleep

import pytest

from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.site import RouterProcess, key, site, total, wait_until
from tests.engine.wire import LEN, tag, varint

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
metrics: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1s
    deadman: {{timeout: 2s, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], at_start: silent}}
  ph_info: {{source: sensor_board, destinations: [driving_board], priority: bulk, deadman: no command at all}}
  pump_info: {{source: sensor_board, destinations: [driving_board], ttl: 1s, deadman: a large command of its own}}
"""
BUDGET = 5000
HOSTS = {"sensor_board": "127.0.0.30", "driving_board": "127.0.0.222", "basestation": "127.0.0.10"}
DRIVE = sample("manual_drive", WIRE.envelope.cases["manual_drive"].message_class(turn=5)).datagram
BRAKE = sample("manual_brake", WIRE.envelope.cases["manual_brake"].message_class(brake=True)).datagram


def large(case: str, size: int) -> bytes:
    """A payload with a field that nobody knows."""
    message = WIRE.envelope.cases[case].message_class.FromString(tag(30, LEN) + varint(size) + bytes(size))
    return sample(case, message).datagram


@pytest.mark.slow
def test_bulk_holds_up_no_command_and_commands_that_never_leave_feed_no_deadman(tmp_path: Path) -> None:
    with site(tmp_path, HOSTS) as place:
        table = place.table(TABLE)
        board = "{}:{}, kind: board".format(*place.endpoints["driving_board"].getsockname())
        table.write_text(table.read_text().replace(board, f"{board}, budget: {BUDGET}B/s"))
        with RouterProcess(tmp_path, table):
            began, commands = monotonic(), 0
            stale = key("messages_dropped", route="manual_drive", target="driving_board", reason="stale")
            while total(counts := place.scrape(), "datagrams_sent", route="ph_info") < 2:
                assert monotonic() < began + 60
                place.send("sensor_board", large("ph_info", 15_000))
                for _ in range(10):
                    place.send("basestation", DRIVE)
                    commands += 1
                    sleep(0.05)
            wait_until(
                lambda: total(place.scrape(), "datagrams_sent", route="manual_drive") == commands, "the last one"
            )
            counts = place.scrape()
            assert counts[stale] == 0
            assert total(counts, "deadman_trips") == 0
            assert BRAKE not in place.waiting()["driving_board"]

            place.send("sensor_board", large("pump_info", 16_000))
            while not total(counts := place.scrape(), "deadman_trips"):
                assert monotonic() < began + 60
                place.send("basestation", DRIVE)
                sleep(0.05)
            assert counts[stale] > 0
            while place.receive("driving_board") != BRAKE:
                pass
            while place.samples()[key("deadman_active", route="manual_drive")]:
                assert monotonic() < began + 60
                place.send("basestation", DRIVE)
                sleep(0.05)
