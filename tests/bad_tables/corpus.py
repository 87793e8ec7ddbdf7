"""The corpus of bad tables: `CODE.md` has tables with one kind of finding, with the output of `router validate`.

A page begins with a correct version of its first table: a table without findings, an envelope.proto, or the
envelope.options of `protos/options`. Each section is named after its table, `bad_tables/NAME.yaml`, and has two
blocks: the table, with its encoding if that is not UTF-8, and the exact text. Most tables extend `base/base.yaml`,
which is valid. docs/reference/findings.md shows the first section and its correct version.

`python -m tests.bad_tables.corpus` writes the texts of new or changed sections. Read them as if you had made the
mistake.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from router.cli import main

HERE = Path(__file__).parent
PAGES = sorted(HERE.glob("*.md"))

_SECTION = re.compile(
    r"^## (?P<name>\S+)\n\n```yaml ?(?P<encoding>\S*)\n(?P<table>.*?)^```\n\n```text\n(?P<said>.*?)^```\n",
    re.MULTILINE | re.DOTALL,
)
_GOOD = re.compile(r"^```(?P<kind>yaml|proto|options) good\n(?P<text>.*?)^```\n", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class BadTable:
    """A section of the corpus: a table with its file name and expected text."""

    code: str
    name: str
    table: bytes
    said: str


def sections(page: Path) -> Iterator[BadTable]:
    text = page.read_text(encoding="utf-8")
    found = list(_SECTION.finditer(text))
    assert len(found) == text.count("\n## "), f"{page.name}: a section is not a heading, a yaml block and a text block"
    for match in found:
        table = match["table"].encode(match["encoding"] or "utf-8")
        yield BadTable(page.stem, match["name"], table, match["said"])


def good(page: Path) -> tuple[str, str]:
    """Return the correct version of a page's first table: `yaml`, `proto` or `options`, and the text."""
    [(kind, text)] = _GOOD.findall(page.read_text(encoding="utf-8"))
    return kind, text


def unpack(folder: Path, tables: list[BadTable]) -> None:
    """Write the tables, and the files that they extend, to `folder/bad_tables`."""
    target = folder / "bad_tables"
    target.mkdir()
    for shared in ("base", "protos"):
        shutil.copytree(HERE / shared, target / shared)
    for table in tables:
        (target / f"{table.name}.yaml").write_bytes(table.table)


def validate(name: str) -> tuple[int, str]:
    """Return exit code and output of `router validate --strict`, started in the folder above `bad_tables`."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = main(["validate", "--strict", f"bad_tables/{name}.yaml"])
    return code, out.getvalue()


def _rewrite(page: Path) -> None:
    def section(match: re.Match[str]) -> str:
        head = match[0][: match.start("said") - match.start()]
        return f"{head}{validate(match['name'])[1]}```\n"

    page.write_text(_SECTION.sub(section, page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        unpack(Path(temporary), [table for page in PAGES for table in sections(page)])
        os.chdir(temporary)
        for page in PAGES:
            _rewrite(page)
