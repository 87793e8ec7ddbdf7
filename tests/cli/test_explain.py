"""`router explain --live` asks the ROS network; tests/transcripts/explain*.md have what else it tells."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from router.cli import OK, main

BASE = Path(__file__).parents[1] / "bad_tables" / "base" / "base.yaml"
GATEWAYS = """\
extends: {base}
gateways:
  vr_headset: {{transport: {{udp: 127.0.0.9:8502}}, topics: {{include: [/*_data]}}}}
  net: {{transport: {{zenoh: {{key: a/b, connect: [tcp/127.0.0.1:7447]}}}}, topics: {{include: [/greeting]}}}}
"""


def test_live_shows_topics_of_the_network_with_who_publishes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.peers import Publisher

    table = tmp_path / "gateways.yaml"
    table.write_text(GATEWAYS.format(base=BASE))

    def explained(gateway: str) -> str:
        assert main(["explain", gateway, "--live", "--for", "500ms", "--table", str(table)]) == OK
        return capsys.readouterr().out

    with closing(Publisher("greeting", "std_msgs/msg/String")):
        while "~" not in (told := explained("net")):
            pass
    assert "  ~ /greeting  std_msgs/msg/String of 1  the latest value every 500 ms  by /greeting\n" in told
    assert "/imu_data  comms/msg/ImuSensorInformation, no publisher  " in explained("vr_headset")
