"""What is said of each change in `history.yaml`, a history of `.proto` files such as a rover's has.

What breaks the wire is accepted by name afterwards, as a team does that flashes all boards; then the lock has it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from router.cli import BAD_TABLE, OK, main
from router.errors import TableError
from router.types.lock import LockComparison
from router.types.protobuf import find_envelope, load_protos
from tests.types.conftest import ONEOF, Write, settings

Change = Mapping[str, Any]

HISTORY = yaml.safe_load((Path(__file__).parent / "history.yaml").read_text(encoding="utf-8"))
CHANGES = HISTORY["changes"]


class Protos:
    """The folder of the protos as the history goes on; it is the working directory."""

    def __init__(self, write: Write) -> None:
        self._write = write
        self._files: dict[str, str] = dict(HISTORY["start"])
        self.root = write(self._files)
        assert self.lock() == OK

    def apply(self, change: Change) -> None:
        for name, edit in change["edits"].items():
            if edit is None:
                del self._files[name]
                (self.root / name).unlink()
            elif isinstance(edit, str):
                self._files[name] = edit
            else:
                assert edit["from"] in self._files[name], f"{change['name']}: {edit['from']}"
                self._files[name] = self._files[name].replace(edit["from"], edit["to"])
        self._write(self._files)

    def findings(self) -> list[str]:
        named = settings(self.root, "PBEnvelope")
        try:
            schema = load_protos(*named)
        except TableError as error:
            return [str(finding) for finding in error.diagnostics]
        found = [*LockComparison(find_envelope(schema, ONEOF)).findings(), *schema.warnings]
        return [str(finding) for finding in found if "takes up to" not in finding.message]

    def lock(self, *accepted: str) -> int:
        """`router schema lock` with the names to accept; the envelope's name as findings have it."""
        message = re.search(r"--message [\w.]+", " ".join(self.findings()))
        words = [*(message[0].split() if message else ()), *(f"--accept={name}" for name in accepted)]
        return main(["schema", "lock", "--protos", ".", *words])


def test_all_that_is_said_of_each_change(write: Write) -> None:
    """Each change is checked, refused by `router schema lock` if it breaks the wire, and then locked."""
    protos = Protos(write)
    for change in CHANGES:
        protos.apply(change)
        assert protos.findings() == change["says"], change["name"]
        if not compiles(change):
            continue
        before = Path("envelope.lock.json").read_bytes()
        if "accept" in change:
            assert protos.lock() == BAD_TABLE, change["name"]
            assert Path("envelope.lock.json").read_bytes() == before, "what is not accepted is not written"
        assert protos.lock(*change.get("accept", ())) == OK, change["name"]
        left = [finding for finding in protos.findings() if "[unused-proto]" not in finding]
        assert left == [], change["name"]


def compiles(change: Change) -> bool:
    return not any("error[bad-proto]" in finding for finding in change["says"])


def test_a_lock_that_is_a_loop_of_links_is_a_finding(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    lock = Protos(write).root / "other.lock.json"
    lock.symlink_to(lock.name)
    assert main(["schema", "lock", "--protos", ".", "--lock", lock.name]) == BAD_TABLE
    assert "error[bad-file]: not a lock file" in capsys.readouterr().err
