"""The page of a real gateway, with a picture that rclpy publishes."""

from __future__ import annotations

import json
import socket
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage

from router.gateway.thread import GatewayThread
from router.library import load
from tests.gateway.browser import Browser
from tests.gateway.pictures import IMAGE, TIMES, png, shown_pixel
from tests.gateway.stage import program
from tests.ports import free_port
from tests.ros.opening import open_ros
from tests.ros.peers import Publisher

pytestmark = pytest.mark.slow


def test_a_picture_of_ros_is_shown_under_the_name_of_the_gateway(tmp_path: Path, browser: Browser) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    gateway = f"camera: {{transport: {{websocket: 127.0.0.1:{port}}}, discovery_period: 50ms}}"
    made = program(tmp_path, gateway)
    picture = png(320, 240, (0, 128, 255))
    message = CompressedImage(format="png", data=list(picture))
    with closing(open_ros()) as ros, closing(Publisher("camera/compressed", IMAGE)) as publisher:
        gateways = GatewayThread(ros, load(), made.counters.fresh_counts(), print, print, Counter(), lambda: None)
        gateways.finish(gateways.prepare(made, {}))
        try:
            page = browser.open(f"http://127.0.0.1:{port}/?topic=/camera/compressed")
            page.until(f"document.title === {json.dumps(f'Gateway camera · 127.0.0.1:{port}')}")
            assert page.evaluate("document.querySelector('#status').href") == "http://127.0.0.1:9108/"
            assert publisher.line() == "matched"
            publisher.publish([serialize_message(message)])
            page.until(
                f"document.querySelector('#picture figcaption').textContent.startsWith('png, 320 {TIMES} 240, ')"
            )
            assert shown_pixel(page) == [0, 128, 255, 255]
            assert page.complaints() == []
        finally:
            gateways.stop()
