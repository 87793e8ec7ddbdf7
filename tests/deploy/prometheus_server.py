"""A real Prometheus with the files of deploy/prometheus, scraping a test's router."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import ROOT, wait_until
from tests.ports import free_port

PROGRAM = shutil.which("prometheus")
SCRAPED = "127.0.0.1:9108"
OF_GATEWAYS = "127.0.0.1:9109"
"""The targets in prometheus.yml: of the router's job, and of the gateways'."""


class PrometheusServer:
    """Scrapes `router`, which also runs the gateways, twice a second and stores its data in `folder`."""

    def __init__(self, folder: Path, router: str) -> None:
        assert PROGRAM
        self.address = f"127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
        config = folder / "config"
        shutil.copytree(ROOT / "deploy/prometheus", config)
        _patch(
            config / "prometheus.yml",
            {SCRAPED: router, f'- targets: ["{OF_GATEWAYS}"]': "", "_interval: 5s": "_interval: 500ms"},
        )
        with (folder / "prometheus.log").open("w") as log:
            self._process = subprocess.Popen(
                [
                    PROGRAM,
                    f"--config.file={config / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'data'}",
                    f"--web.listen-address={self.address}",
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def __enter__(self) -> PrometheusServer:
        wait_until(self._is_ready, "Prometheus being ready")
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(PATIENCE)

    def query(self, expression: str) -> list[dict[str, Any]]:
        """The result of an expression at the newest scrape: series with `metric` (labels) and `value`.

        If the router was too busy to answer the last scrape, waits for the next one, because after a failed scrape a
        router has no series.
        """
        scrape: list[dict[str, Any]] = []

        def answered() -> bool:
            scrape[:] = self._at("timestamp(up == 1)", time.time())
            return bool(scrape)

        wait_until(answered, "a scrape")
        return self._at(expression, scrape[0]["value"][1])

    def firing(self, alert: str) -> list[Mapping[str, str]]:
        """The label sets with which an alert is firing."""
        alerts = self._get("alerts")["alerts"]
        return [each["labels"] for each in alerts if each["labels"]["alertname"] == alert and each["state"] == "firing"]

    def _at(self, expression: str, instant: object) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self._get("query", query=expression, time=instant)["result"]
        return found

    def _get(self, what: str, **parameters: object) -> Any:
        url = f"http://{self.address}/api/v1/{what}?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{parameters}: {error.read().decode()}") from error

    def _is_ready(self) -> bool:
        assert self._process.poll() is None, "Prometheus ended; see prometheus.log"
        try:
            with urllib.request.urlopen(f"http://{self.address}/-/ready", timeout=PATIENCE) as answer:
                return bool(answer.status == 200)
        except OSError:
            return False


def _patch(file: Path, changes: Mapping[str, str]) -> None:
    text = file.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)
