"""What a router with a carrier generates: handlers of what Python serves, and no others."""

from __future__ import annotations

import os
import re

import pytest

if os.environ.get("ROUTER_CARRIER") == "python":
    pytest.skip("is about the carrier", allow_module_level=True)

from router.app import Router
from router.compiler.source import Source
from tests.app.conftest import Site
from tests.ports import free_port

ROUTES = """\
  ph_info:
    source: any
    destinations: [basestation, {endpoint: slow, max_rate: 1 Hz, on_limit: latest}]
  imu_info: {source: any, destinations: [basestation]}
"""


def test_only_what_python_serves_is_compiled(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    compile_ = Source.compile

    def recorded(self: Source, file: str) -> object:
        compiled.append(self.text())
        return compile_(self, file)

    monkeypatch.setattr(Source, "compile", recorded)
    program = site.program(ROUTES, endpoints=f'  slow: {{address: "127.0.0.1:{free_port()}", kind: basestation}}\n')
    with Router(program):
        (handler,) = compiled
    assert re.findall(r"(?:send|deliver)_\w+", handler) == ["deliver_slow"]
