"""A router of which only the counters exist, with clocks that a test sets."""

from __future__ import annotations

from router.compiler.compiled_table import CompiledTable
from router.observe.health import HealthSnapshot
from router.observe.watch import Watch
from tests.observe.fake_running import FakeRunning

SECOND = 10**9
START = 100 * SECOND

TABLE = """\
version: 1
extends: {routes}/rover.yaml
endpoints:
  sensor_board: {{stale_after: 3s}}
  arm_board: {{stale_after: never}}
routes:
  ph_info: {{source: [sensor_board, arm_board]}}
  drive_motor:
    source: {{topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage, when: state.mode == MODE_AUTO}}
  manual_drive: {{deadman: {{obeyed: {{drive_diag: abs(front_left_motor.rpm) < 5, within: 2s}}}}}}
state:
  mode: {{case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL, valid_for: 5s}}
  driver: {{topic: driver, type: std_msgs/msg/String, value: data, initial: "''", valid_for: 1s}}
gateways:
  dashboard:
    inbound:
      - topic: /cmd_vel
        type: geometry_msgs/msg/Twist
        deadman: {{timeout: 500ms, send: {{}}}}
"""


class Counting(FakeRunning):
    """`now` is the boot clock in ns."""

    def __init__(self, program: CompiledTable) -> None:
        super().__init__(program)
        self.now = self.began = START
        self.sent = 0
        self.watch = Watch(self)
        self.count("config_last_reload_successful", to=1)

    def clock_ns(self) -> int:
        return self.now

    def hear(self, endpoint: str) -> None:
        self.count("endpoint_silence_seconds", endpoint, to=self.now)

    def look(self, after: float) -> HealthSnapshot:
        """Evaluate health this many seconds later."""
        self.now += int(after * SECOND)
        return self.watch.look(self.now)

    def told(self, after: float) -> list[str]:
        """Evaluate health then, and return the problems as text."""
        return [problem.text for problem in self.look(after).problems]
