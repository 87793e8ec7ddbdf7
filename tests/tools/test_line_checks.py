"""What the doctor finds about the devices of serial lines."""

from __future__ import annotations

import os
import pwd
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from grp import struct_group
from pathlib import Path

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.tools import line_checks
from router.tools.doctor import before_start, examine
from router.tools.doctor_checks import (
    CheckResult,
    Grade,
    endpoints,
    listeners,
    ports,
    receive_buffers,
)
from router.tools.line_checks import lines
from router.tools.links import Pty
from tests.small_tables import HEAD
from tests.tables import PROTOS

ROUTES = "  ph_info: {source: lander, destinations: [basestation]}\n"


def program(folder: Path, device: str | Path) -> CompiledTable:
    line = f"  uart: {{serial: {device}, baud: 9600, framing: cobs}}\n"
    head = HEAD.replace("endpoints:\n", f"{line}endpoints:\n  lander: {{listener: uart, kind: board}}\n")
    (folder / "table.yaml").write_text((head + ROUTES).replace("PROTOS", str(PROTOS)))
    compiled = check_table(folder / "table.yaml", {}).program
    assert compiled is not None
    return compiled


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Path]:
    """A serial device that is there."""
    with closing(Pty(program(tmp_path, tmp_path / "uart").table.lines[0])):
        yield tmp_path / "uart"


@contextmanager
def another_process(code: str) -> Iterator[subprocess.Popen[str]]:
    """It says something when it is ready, and ends with its input."""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process
        process.communicate("")


def gist(found: list[CheckResult]) -> list[tuple[Grade, str]]:
    return [(each.grade, each.text) for each in found]


def test_a_device_that_is_there_is_fine(tmp_path: Path, pty: Path) -> None:
    """Neither a port nor a ping belongs to a line."""
    found = program(tmp_path, pty)
    assert gist([*lines(found, running=False)]) == [(Grade.FINE, f"listener 'uart': {pty} is there")]
    others = [*listeners(found), *ports(found, running=False), *endpoints(found, {}), *receive_buffers(found)]
    assert all("uart" not in each.text and "lander" not in each.text for each in others)


@pytest.mark.parametrize("look", [examine, before_start])
def test_a_missing_device_is_a_warning(tmp_path: Path, look: type) -> None:
    program(tmp_path, "/dev/nowhere")
    found = [each for each in look(tmp_path / "table.yaml", {}) if "uart" in each.text]
    assert gist(found) == [(Grade.WARNING, "listener 'uart' cannot open /dev/nowhere: its device is not there")]


def test_similar_names_of_devices_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_checks, "BY_ID", tmp_path)
    (tmp_path / "usb-Raspberry_Pi_Pico_E6614103-if00").touch()
    [found] = lines(program(tmp_path, tmp_path / "usb-Raspberry_Pi_Pico_E6614104-if00"), running=False)
    assert found.remedy == "did you mean 'usb-Raspberry_Pi_Pico_E6614103-if00'?; the router waits for it"


@pytest.mark.parametrize("device", ["/dev/null", "/etc/passwd"])
def test_what_is_no_serial_device_is_a_problem(tmp_path: Path, device: str) -> None:
    found = gist([*lines(program(tmp_path, device), running=False)])
    assert found == [(Grade.PROBLEM, f"listener 'uart' cannot open {device}: it is no serial device")]


@pytest.mark.parametrize(
    ("mode", "members", "remedy"),
    [
        (0o660, [], r"run `sudo usermod -aG dialout \w+`, and log in again"),
        (0o660, [pwd.getpwuid(os.geteuid()).pw_name], r"log in again: \w+ has been added to the group dialout since"),
        (0o620, [], "have a udev rule give it a group that may write it, .*docs/guides/serial-line.md#on-the-rover"),
    ],
)
def test_a_user_without_the_group_of_the_device_is_told(
    tmp_path: Path, pty: Path, monkeypatch: pytest.MonkeyPatch, mode: int, members: list[str], remedy: str
) -> None:
    found = program(tmp_path, pty)
    pty.chmod(mode)
    if not os.geteuid():
        os.chown(pty, 0, 1)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may open everything
    monkeypatch.setattr("grp.getgrgid", lambda gid: struct_group(("dialout", "", gid, members)))
    [refused] = lines(found, running=False)
    assert (refused.grade, refused.text) == (Grade.PROBLEM, f"listener 'uart' cannot open {pty}: this user may not")
    assert re.fullmatch(remedy, refused.remedy)
    assert gist([*lines(found, running=True)]) == [(Grade.FINE, f"listener 'uart': {pty} is there")]


def test_who_has_the_device_is_told(tmp_path: Path, pty: Path) -> None:
    found = program(tmp_path, pty)
    with another_process(
        f"import sys; file = open('{pty}', 'rb', 0); print('ready', flush=True); sys.stdin.read()"
    ) as it:
        [held] = lines(found, running=False)
        assert held.grade is Grade.PROBLEM
        assert held.text.startswith(f"listener 'uart' cannot open {pty}: ")
        assert held.text.endswith(f" (pid {it.pid}) has it")
        [held] = lines(found, running=True)
        assert (held.grade, held.text.endswith(f"(pid {it.pid}) has it")) == (Grade.FINE, True)


def test_modem_manager_is_a_warning_unless_udev_tells_it_to_ignore_the_device(
    tmp_path: Path, pty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = program(tmp_path, pty)
    monkeypatch.setattr(line_checks, "_USB", (pty.resolve().name,))
    monkeypatch.setattr(line_checks, "UDEV", tmp_path)
    name = (
        "import ctypes, sys; ctypes.CDLL(None).prctl(15, b'ModemManager'); print('ready', flush=True); sys.stdin.read()"
    )
    with another_process(name):
        [_, warned] = lines(found, running=False)
        assert warned.grade is Grade.WARNING
        assert f"ModemManager runs, which may have {pty} for seconds" in warned.text
        number = pty.stat().st_rdev
        (tmp_path / f"c{os.major(number)}:{os.minor(number)}").write_text("E:ID_MM_DEVICE_IGNORE=1\n")
        assert len([*lines(found, running=False)]) == 1
    (tmp_path / f"c{os.major(number)}:{os.minor(number)}").unlink()
    assert len([*lines(found, running=False)]) == 1
