"""Which files a new message changes and to what, and writing them: all, or none.

Decides nothing about the message, and prints nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from router.errors import UsageError, shown_path
from router.table.model import RouteTable
from router.tools.new_message_model import NewMessage, Site
from router.tools.new_message_proto import proto_texts
from router.tools.new_message_ros import msg_text
from router.tools.new_message_tables import board_table_text, forwarding_table_text
from router.tools.new_message_testing import with_test


@dataclass(frozen=True, slots=True)
class Changes:
    """`texts` are the whole contents of each file. `unrouted` are tables beside that need a person to route it."""

    texts: Mapping[Path, str]
    unrouted: tuple[Path, ...]


def changes(message: NewMessage, site: Site, others: Sequence[RouteTable]) -> Changes:
    """`others` are the tables beside the site's. Raises UsageError, and TableError for a broken test file."""
    texts = {site.schema.root / name: text for name, text in proto_texts(message, site).items()}
    texts[site.messages / f"{message.name}.msg"] = msg_text(message, site)
    path = site.table.path
    package = site.messages.parent.name
    texts[path] = board_table_text(_read(path), message, site.table, shown_path(path), package)
    tests = path.with_name(f"{path.stem}.test{path.suffix}")
    if tests.exists():
        texts[tests] = with_test(tests, _read(tests), message, site)
    unrouted = []
    for other in others:
        if path in other.files or _protos(other) != _protos(site.table):
            continue
        text = forwarding_table_text(_read(other.path), message, other, shown_path(other.path))
        if text is None:
            unrouted.append(other.path)
        else:
            texts[other.path] = text
    return Changes(texts, tuple(unrouted))


def _protos(table: RouteTable) -> Path | None:
    return table.envelope.protos.value if table.envelope else None


class Written:
    """The files of some changes, written, their ends of lines as they were.

    Raises UsageError when one cannot be written, and then none is.
    """

    def __init__(self, texts: Mapping[Path, str]) -> None:
        self._before: dict[Path, bytes | None] = {}
        self._folders: list[Path] = []
        try:
            for path, text in texts.items():
                self._write(path, text)
        except OSError as error:
            self.undo()
            raise UsageError(f"{error.filename} cannot be written: {error.strerror}") from error
        except BaseException:  # somebody pressed Ctrl-C
            self.undo()
            raise

    def _write(self, path: Path, text: str) -> None:
        before = path.read_bytes() if path.exists() else None
        self._before[path] = before
        self._folders += [folder for folder in path.parents if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\r\n" if before and b"\r\n" in before else "\n")

    @property
    def new(self) -> list[Path]:
        return [path for path, before in self._before.items() if before is None]

    @property
    def changed(self) -> list[Path]:
        return [path for path, before in self._before.items() if before is not None]

    def undo(self) -> None:
        """Everything as it was."""
        for path, before in self._before.items():
            if before is None:
                path.unlink(missing_ok=True)
            elif path.read_bytes() != before:
                path.write_bytes(before)
        for folder in self._folders:  # the innermost first
            folder.rmdir()


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")
