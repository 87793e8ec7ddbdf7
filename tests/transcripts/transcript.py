"""Transcripts: pages with commands, each with all that it prints, in the format of the documentation's pages.

CONTRIBUTING.md has the format. Three things differ from the documentation. A command without output prints nothing. A
page is gone through in a new folder, which has `rover/` (tests/rover), `site/` (tests/tools/new_message_site),
`bad_tables/base/` and `bad_tables/protos/`; `FOLDER` stands for its path, and what the router ships is first looked for
there. `router` runs in this process, unless the command needs a shell; other commands run in a shell, each for itself.

`python -m tests.transcripts.transcript [PAGE ...]` writes what the commands print now, and keeps each line with `...`
that still holds. Read the difference before you commit it.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from router import assets
from router.cli import main
from tests.bad_tables.corpus import HERE as BAD_TABLES
from tests.docs_commands import ANY, Command, File, steps
from tests.tables import RIG

HERE = Path(__file__).parent
PAGES = sorted(HERE.glob("*.md"))
SITE = HERE.parent / "tools" / "new_message_site"

_NEEDS_A_SHELL = re.compile(r"[|&;<>$`\n]|^(?!(\w+=\S* )*router )")
_ENVIRONMENT = {"COLUMNS": "100", "NO_COLOR": "1"}


class Played(NamedTuple):
    """A command of a page with its result."""

    command: Command
    output: str
    code: int

    @property
    def is_as_shown(self) -> bool:
        printed = self.command.is_printed(self.output) if self.command.printed else not self.output.strip()
        return printed and self.code == self.command.code

    @property
    def shown(self) -> list[str]:
        """The command's text in a page; matching lines with `...` are kept."""
        masked = [line for line in self.command.printed if ANY in line and line != ANY]
        lines = []
        for line in self.output.rstrip().splitlines():
            holding = (each for each in masked if Command(0, "", (each,)).is_printed(line))
            lines.append(next(holding, line.rstrip()))
        return [*lines, *([f"# exit code {self.code}"] if self.code else [])]


@contextlib.contextmanager
def folder(path: Path) -> Iterator[None]:
    """Work in a folder for one page."""
    shutil.copytree(RIG, path / "rover")
    shutil.copytree(SITE, path / "site")
    for part in ("base", "protos"):
        shutil.copytree(BAD_TABLES / part, path / "bad_tables" / part)
    before = Path.cwd()
    places = (path, *assets._PLACES)
    environment = {**_ENVIRONMENT, "XDG_CACHE_HOME": f"{path}/cache"}
    with patch.dict(os.environ, environment), patch.object(assets, "_PLACES", places):
        for name in ("ROUTER_TABLE", "RECORDINGS", "STATE_DIRECTORY"):
            os.environ.pop(name, None)
        os.chdir(path)
        try:
            yield
        finally:
            os.chdir(before)


def play(page: Path) -> Iterator[Played]:
    """Go through a page in the working directory."""
    for step in steps(page):
        if isinstance(step, File):
            Path(step.path).parent.mkdir(parents=True, exist_ok=True)
            Path(step.path).write_text(step.text, encoding="utf-8")
        elif _NEEDS_A_SHELL.search(step.text):
            yield _played(step, *_in_a_shell(step.text))
        else:
            yield _played(step, *_in_this_process(step.text))


def _played(command: Command, output: str, code: int) -> Played:
    return Played(command, output.replace(str(Path.cwd()), "FOLDER"), code)


def _in_a_shell(text: str) -> tuple[str, int]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["/bin/bash", "-c", text],
        env={**os.environ, "PATH": path},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    return done.stdout, done.returncode


def _in_this_process(text: str) -> tuple[str, int]:
    words = shlex.split(text)
    first = words.index("router")
    out = io.StringIO()
    with (
        patch.dict(os.environ, dict(word.split("=", 1) for word in words[:first])),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(out),
    ):
        try:
            code = main(words[first + 1 :])
        except SystemExit as ended:
            code = int(ended.code or 0)
    return out.getvalue(), code


def rewrite(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").splitlines()
    for played in reversed(list(play(page))):
        if not played.is_as_shown:
            command = played.command
            start = command.line + command.text.count("\n")
            end = start
            while not lines[end].startswith(("$ ", "```")):
                end += 1
            lines[start:end] = played.shown
    page.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    for each in [HERE / name for name in sys.argv[1:]] or PAGES:
        with tempfile.TemporaryDirectory() as temporary, folder(Path(temporary)):
            rewrite(each)
