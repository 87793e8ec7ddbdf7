"""Run each command of the README and of the users' pages, from top to bottom, in a fresh clone."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, NoReturn

import pytest

from tests.boards.board import skip_without_nanopb
from tests.docs_commands import Block, Command, File, blocks, commands, steps
from tests.namespaces import computers

ROOT = Path(__file__).parent.parent
FOLDERS = ("start", "guides", "troubleshooting")
PAGES = [ROOT / "README.md", *(page for folder in FOLDERS for page in sorted((ROOT / "docs" / folder).glob("*.md")))]
NEEDS = ("git", "tar", "ip", "unshare")
PATIENCE = 60.0
"""Timeout of one command, in seconds."""

FIRST_LINE = 10.0
"""Seconds to wait for the first line of a background process before the next command."""

UNSAID = ("", "bash", "shell")


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


pages = pytest.mark.parametrize("page", PAGES, ids=name)


@pages
def test_each_block_says_what_it_is(page: Path) -> None:
    found = [f"{name(page)}:{block.line - 1}" for block in blocks(page) if block.language in UNSAID]
    assert found == [], "commands are in `console` or `sh` blocks, other text in `text` blocks"


@pages
def test_each_block_with_commands_can_be_read(page: Path) -> None:
    for block in blocks(page):
        if block.language == "console":
            assert list(commands(block))


def test_output_is_compared_with_what_is_shown() -> None:
    block = Block(
        "console", 7, ("$ one \\", "> two", "a ... c", "...", "z", "# exit code 3", "$ three &", "ready"), True
    )
    one, three = commands(block)
    assert (one.line, one.text, one.code, one.is_background) == (7, "one \\\ntwo", 3, False)
    assert one.is_printed("a b c\nz\n")
    assert one.is_printed("a b c  \n1\n2\nz\n\n")
    assert not one.is_printed("a b\nz\n")
    assert not one.is_printed("a b c\nz\nmore\n")
    assert (three.line, three.is_background) == (13, True)
    assert three.is_printed("ready\nmore\n")
    assert not three.is_printed("more\n")


def test_commands_to_paste_are_steps_of_their_own(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("Paste:\n\n```sh\nmake\nrouter demo &\n```\n")
    one, two = steps(page)
    assert (one, two) == (Command(4, "make", ()), Command(5, "router demo &", ()))


@pytest.mark.slow
@pages
def test_commands_of_a_page_print_what_it_shows(page: Path, tmp_path: Path) -> None:
    todo = steps(page)
    if not any(isinstance(step, Command) for step in todo):
        pytest.skip("it has no commands")
    if missing := [program for program in NEEDS if shutil.which(program) is None]:
        pytest.skip(f"needs {', '.join(missing)}")
    if any(isinstance(step, Command) and "-lprotobuf-nanopb" in step.text for step in todo):
        skip_without_nanopb()
    clone = tmp_path / "rover-router"
    fresh_clone(clone)
    go_through(todo, clone, name(page), tmp_path)


def go_through(todo: Iterable[File | Command], clone: Path, page: str, folder: Path) -> None:
    with shell(clone, folder) as there:
        for step in todo:
            if isinstance(step, File):
                there.write(step)
            else:
                there.run(step, f"{page}:{step.line}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (("$ echo a", "b"), "expected:\nb\n\ngot:\na"),
        (("$ true", "a"), "expected:\na\n\ngot:"),
        (("$ false",), "exit code 1 instead of 0"),
        (("$ true", "# exit code 1"), "exit code 0 instead of 1"),
        (("$ exit 3",), "the shell has ended"),
        (("$ false &",), "it ended with exit code 1"),
        (("$ echo a &", "b"), "expected:\nb\n\ngot:\na"),
    ],
)
def test_a_page_that_is_wrong_fails(lines: tuple[str, ...], said: str, tmp_path: Path) -> None:
    with pytest.raises(pytest.fail.Exception, match=said):
        go_through(commands(Block("console", 1, lines, True)), ROOT, "page", tmp_path)


def fresh_clone(folder: Path) -> None:
    """A copy of the checkout, including uncommitted changes, with its environment and library already built.

    Made by other programs, because tests may not read a team's tables.
    """
    folder.mkdir()
    copying = f"""
        git -C {ROOT} ls-files -z --cached --others --exclude-standard |
            tar -C {ROOT} --null --ignore-failed-read -T - -c 2> /dev/null | tar -x
        ln -s {ROOT}/.venv .venv
        cp {ROOT}/router/carrier/native/libcarrier.so router/carrier/native/ 2> /dev/null
        cp {ROOT}/router/declared.py router/ 2> /dev/null
        echo 'echo "setup: .venv is up to date"' > deploy/setup.sh
        git init -q && git add -A && git -c user.name=test -c user.email=test@localhost commit -qm clone
    """
    subprocess.run(["/bin/bash", "-c", copying], cwd=folder, check=True, timeout=PATIENCE)


class Job(NamedTuple):
    """A background process. `ended` gets its exit code."""

    place: str
    command: Command
    log: Path
    ended: Path


class Shell:
    """A shell that runs the commands of a page. `cd` and `export` persist."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self._process = process
        self._folder = folder
        self._number = 0
        self._jobs: list[Job] = []

    def write(self, file: File) -> None:
        """Write a file relative to the shell's working directory, which commands may have changed."""
        text = self._folder / "file"
        text.write_text(file.text, encoding="utf-8")
        path = f"'{file.path}'"
        code, output = self._enter(f"mkdir -p $(dirname {path}) && cp {text} {path}")
        assert code == 0, f"{file.path}: {output}"

    def run(self, command: Command, place: str) -> None:
        if command.is_background:
            code, output = command.code, self._start(command, place)
        else:
            code, output = self._enter(command.text, place)
        if code != command.code:
            self._fail(place, command.text, f"exit code {code} instead of {command.code}; it printed:\n{output}")
        if not command.is_printed(output):
            self._fail(place, command.text, "\n".join(["expected:", *command.printed, "", "got:", output]))

    def _start(self, command: Command, place: str) -> str:
        """Start a background process and return its output until the next command."""
        log, ended = self._output(self._number + 1), self._folder / f"{self._number + 1}.ended"
        self._jobs.append(Job(place, command, log, ended))
        self._enter(f"{{ {command.text.removesuffix(' &')}\necho $? > {ended}\n}} &", place)
        seconds = PATIENCE if command.printed else FIRST_LINE
        self._until(lambda: read(ended) != "" or (read(log) != "" and command.is_printed(read(log))), seconds)
        return read(log)

    def _fail(self, place: str, text: str, what: str) -> NoReturn:
        beside = [f"\nmeanwhile {job.place}: $ {job.command.text}\n{read(job.log)[-2000:]}" for job in self._jobs]
        pytest.fail("\n".join([f"{place}: $ {text}", what, *beside]), pytrace=False)

    def end_jobs(self) -> None:
        """Send SIGINT to all jobs, and check that none has exited with a code that the page does not name."""
        for job in self._jobs:
            if (code := read(job.ended)) and int(code) != job.command.code:
                self._fail(job.place, job.command.text, f"it ended with exit code {code}")
        if self._jobs and self._process.poll() is None:
            self._enter("kill -INT $(jobs -p | sed 's/^/-/'); wait", patience=10.0)

    def _enter(self, text: str, place: str = "", patience: float = PATIENCE) -> tuple[int, str]:
        """Run a command and return its exit code and output."""
        self._number += 1
        log, ended = self._output(self._number), self._folder / f"{self._number}.code"
        assert self._process.stdin is not None
        self._process.stdin.write(
            f"{{ {text}\n}} < /dev/null > {log} 2>&1\necho $? > {ended}.new; mv {ended}.new {ended}\n"
        )
        self._process.stdin.flush()
        self._until(lambda: ended.exists() or self._process.poll() is not None, patience)
        if not ended.exists():
            how = "the shell has ended" if self._process.poll() is not None else f"not over after {patience:.0f} s"
            if place:
                self._fail(place, text, f"{how}; it printed:\n{read(log)}")
            return 1, how
        return int(read(ended)), read(log)

    def _output(self, number: int) -> Path:
        return self._folder / f"{number}.txt"

    def _until(self, condition: Callable[[], bool], seconds: float) -> None:
        until = time.monotonic() + seconds
        while not condition() and time.monotonic() < until:
            time.sleep(0.02)


def read(file: Path) -> str:
    return file.read_text(encoding="utf-8", errors="replace") if file.exists() else ""


@contextmanager
def shell(clone: Path, folder: Path) -> Iterator[Shell]:
    """A shell in its own network and PID namespaces; all its processes end with it."""
    home, logs = folder / "home", folder / "logs"
    home.mkdir()
    logs.mkdir()
    environment = {
        "HOME": str(home),
        "PATH": f"{clone}/.venv/bin:{os.environ['PATH']}",
        "PYTHONPATH": str(clone),
        "LANG": "C.UTF-8",
        "COLUMNS": "120",
        "ROS_DOMAIN_ID": "42",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    with computers("docs") as [computer]:
        command = ["ip", "netns", "exec", computer.namespace, "unshare", "--pid", "--fork", "--kill-child"]
        process = subprocess.Popen(
            [*command, "bash", "--noprofile", "--norc"],
            cwd=clone,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            assert process.stdin is not None
            process.stdin.write("set -m\n. .venv/env.sh\n")  # with job control, SIGINT reaches background processes
            there = Shell(process, logs)
            yield there
            there.end_jobs()
        finally:
            process.kill()
            process.wait()
