"""Each command of the transcripts prints what stands below it."""

from __future__ import annotations

import difflib
from pathlib import Path

import pytest

from tests.transcripts.transcript import PAGES, folder, play, rewrite

WRITTEN = """\
```console
$ echo a; false
b
$ true
b
$ router tpo
router: there is no verb 'top'
help: did you mean ...
# exit code 2

$ A=1 bash -c 'echo $A $PWD/x'
```
"""
REWRITTEN = """\
```console
$ echo a; false
a
# exit code 1
$ true
$ router tpo
router: there is no verb 'tpo'
help: did you mean ...
# exit code 2
$ A=1 bash -c 'echo $A $PWD/x'
1 FOLDER/x
```
"""


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_commands_print_what_the_page_shows(page: Path, tmp_path: Path) -> None:
    with folder(tmp_path):
        wrong = [played for played in play(page) if not played.is_as_shown]
    told = []
    for played in wrong:
        told.append(f"{page.name}:{played.command.line}: $ {played.command.text}")
        told += difflib.unified_diff(played.command.printed, played.shown, "page", "now", lineterm="")
    assert wrong == [], "\n".join([*told, "`python -m tests.transcripts.transcript` writes what they print now"])


def test_a_page_that_is_wrong_fails_and_is_rewritten_with_the_masks_that_hold(tmp_path: Path) -> None:
    page, work = tmp_path / "page.md", tmp_path / "work"
    page.write_text(WRITTEN)
    with folder(work):
        assert not any(played.is_as_shown for played in play(page))
        rewrite(page)
        assert page.read_text() == REWRITTEN
        assert all(played.is_as_shown for played in play(page))
