"""A Zenoh gateway in a separate process: `Gateway` starts this file as a script.

It opens at the first line on stdin, and prints each change of its state as a line of JSON.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent.parent))  # sys.path of a script lacks the repository's root

from structlog.testing import capture_logs

from router.errors import Located, SourceSpan
from router.gateway.transport.zenoh import ZenohTransport
from router.table.model.gateways import ZenohConfig, ZenohSettings
from tests.gateway.transport_events import Events

HERE = SourceSpan("routes/rover.yaml")


class Gateway:
    """A Zenoh gateway that connects to the locator `where` as a client, or in another mode. Close it after use."""

    def __init__(self, key: str, where: str, config: dict[str, Any] | None = None, mode: str = "client") -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__, key, where, json.dumps(config or {}), mode],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.states: list[dict[str, Any]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self.states.append(json.loads(line))

    def open(self) -> None:
        assert self.process.stdin
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    @property
    def is_up(self) -> bool:
        """Whether the process is ready to open the gateway."""
        return bool(self.states)

    @property
    def is_ready(self) -> bool:
        return bool(self.states and self.states[-1]["ready"])

    @property
    def waits(self) -> bool:
        """Whether it waits for another gateway that has the key."""
        return bool(self.states and not self.states[-1]["ready"] and self.states[-1]["others"])

    @property
    def others(self) -> list[str]:
        """The owners of the key, as logged at level error."""
        others: list[str] = self.states[-1]["others"]
        return others

    @property
    def contentions(self) -> int:
        return int(self.states[-1]["contentions"])

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    close = kill


async def main(key: str, where: str, config: str, mode: str) -> None:
    """A peer whose mode is "listening" listens at `where`."""
    events = Events()
    settings = ZenohSettings(Located(key, HERE), mode, (where,), (), ZenohConfig(HERE, config))
    if mode == "listening":
        settings = replace(settings, mode="peer", connect=(), listen=(where,))
    transport = ZenohTransport(settings, events, 1000)
    print(json.dumps({"ready": False, "others": [], "contentions": 0}), flush=True)
    await asyncio.to_thread(sys.stdin.readline)
    with capture_logs() as logs:
        await transport.open()
        told = None
        while True:
            others = [log["other"] for log in logs if log["log_level"] == "error"]
            state = {"ready": bool(events.clients), "others": others, "contentions": events.contentions}
            if state != told:
                told = state
                print(json.dumps(state), flush=True)
            await asyncio.sleep(0.005)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
