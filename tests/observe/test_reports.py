"""What is logged of lost messages."""

from __future__ import annotations

import errno
from dataclasses import replace

import pytest
from structlog.testing import capture_logs

from router.compiler.compiled_table import DeadmanPlan
from router.compiler.metrics import Mismatch, Report
from router.log import logger
from router.observe.reports import MOST_MISMATCHES, Reporter
from router.table.addresses import Address

REFUSED = ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")


@pytest.mark.parametrize(
    ("kind", "target", "error", "said"),
    [
        ("deadman", "driving_board", REFUSED, "nobody listens at 127.0.0.222:25008"),
        ("drop", "driving_board", REFUSED, "nobody listens at 127.0.0.222:25008"),
        ("drop", "clients", REFUSED, str(REFUSED)),
        (
            "drop",
            "driving_board",
            OSError(errno.EACCES, "x"),
            "a route or rule of this computer prohibits sending to 127.0.0.222: `ip route get 127.0.0.222`",
        ),
        (
            "deadman",
            "driving_board",
            OSError(errno.EPERM, "x"),
            "a firewall of this computer forbids sending to 127.0.0.222:25008: `nft list ruleset`",
        ),
        ("drop", "driving_board", OSError(errno.EMSGSIZE, "Message too long"), "Message too long"),
    ],
)
def test_a_refused_datagram_is_explained(
    kind: str, target: str, error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[object] = []
    monkeypatch.setattr(logger, "warning", lambda _, **fields: logged.append(fields["error"]))
    reporter = Reporter({"driving_board": Address("127.0.0.222", 25008)}.get)
    reporter.report(Report(kind, "manual_drive", target, "send_error", error))
    reporter.close()
    assert logged == [said]


def test_of_strangers_the_latest_are_remembered() -> None:
    reporter = Reporter(lambda _: None)
    seen = [
        Mismatch("rover", f"10.0.{number >> 8}.{number & 255}", "imu_info") for number in range(MOST_MISMATCHES + 9)
    ]
    for mismatch in (seen[0], *seen[1:40], seen[0], *seen[40:]):
        reporter.report(Report("reject", "rover", "", "source_mismatch", mismatch=mismatch))
    reporter.close()
    assert list(reporter.mismatches()) == [*seen[10:40], seen[0], *seen[40:]]


PLAN = DeadmanPlan("manual_drive", 10**12, 10**8, (("driving_board", (b"",)),))
OF_CLIENTS = DeadmanPlan("phone:/cmd_vel", 10**12, 10**8, (("/cmd_vel", (b"",)),))


@pytest.mark.parametrize(
    ("plan", "lost", "reason"),
    [
        (PLAN, Report("drop", "manual_drive", "driving_board", "stale", None, "too old"), "stale"),
        (OF_CLIENTS, Report("drop", "phone", "/cmd_vel", "stale", None, "too old"), "stale"),
        (PLAN, Report("drop", "manual_drive", "drive_topic", "mapping_error", None, "another target"), None),
        (PLAN, Report("drop", "drive_motor", "driving_board", "stale", None, "another route"), None),
        (replace(PLAN, timeout=0), Report("drop", "manual_drive", "driving_board", "stale", None, "long ago"), None),
        (None, Report("drop", "manual_drive", "driving_board", "stale", None, "of an earlier table"), None),
    ],
)
def test_a_deadman_that_trips_says_whether_commands_come_and_are_dropped(
    plan: DeadmanPlan | None, lost: Report, reason: str | None
) -> None:
    with capture_logs() as logged:
        reporter = Reporter(lambda _: None)
        reporter.report(lost)
        reporter.deadman_changed(plan.route if plan else "manual_drive", active=True, plan=plan)
        reporter.close()
    *_, line = logged
    assert line.get("reason") == reason
    assert line["event"].startswith("commands arrive but are dropped" if reason else "no commands arrive")


@pytest.mark.parametrize(("reason", "lines"), [("send_buffer_full", 2 + 2), ("mapping_error", 20)])
def test_a_deadman_that_is_fed_by_commands_that_only_the_kernel_takes_is_told_in_summary(
    reason: str, lines: int
) -> None:
    with capture_logs() as logged:
        reporter = Reporter(lambda _: None)
        for _ in range(10):
            reporter.report(Report("drop", "manual_drive", "driving_board", reason))
            reporter.deadman_changed("manual_drive", active=True, plan=PLAN)
            reporter.deadman_changed("manual_drive", active=False, plan=PLAN)
        reporter.close()
    of_deadman = [line for line in logged if "deadman" in line["event"]]
    assert len(of_deadman) == lines
    if reason == "send_buffer_full":
        assert [line["event"].partition(";")[0] for line in of_deadman[:2]] == [
            "commands arrive but are dropped",
            "commands are sent again",
        ]
        assert all(line["more"] == 9 for line in of_deadman[2:])
