"""nanopb's `.options` files."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.errors import Code
from router.types.boards import NO_OPTIONS, BoardOptions, read_options


def test_later_lines_win_and_a_field_wins_over_its_message(tmp_path: Path) -> None:
    path = tmp_path / "a.options"
    path.write_text("A.x max_size:1\nA max_size:5 max_count:7\nA.x max_size:2\nA.x max_size:3\n")
    options, findings = read_options(path)
    assert findings == []
    assert options.of("A", "x") == BoardOptions(max_size=3, max_count=7)
    assert options.of("A", "y") == BoardOptions(max_size=5, max_count=7)
    assert options.of("B", "x") == NO_OPTIONS


@pytest.mark.parametrize(
    ("line", "finding"),
    [
        ("A.x", "no option after the name; write for example 'max_size:16'"),
        ("A.x 16", "'16' is no option of nanopb; write for example 'max_size:16'"),
        ("A.x max_size:", "'max_size:' is no option of nanopb; write for example 'max_size:16'"),
        ("A.x max_size:many", "max_size cannot be 'many'"),
        ("A.x max_size:-1", "max_size cannot be '-1'"),
        ("A.x fixed_count:3", "fixed_count cannot be '3'"),
        ("A.x type:FT_STATC", "type cannot be 'FT_STATC'"),
        ("A.x max_szie:3", "the router cannot tell sizes with nanopb's option 'max_szie'; did you mean 'max_size'?"),
        ("A.x no_unions:true", "the router cannot tell sizes with nanopb's option 'no_unions'"),
    ],
)
def test_line_that_cannot_be_understood_is_a_finding(tmp_path: Path, line: str, finding: str) -> None:
    path = tmp_path / "a.options"
    path.write_text(f"# boards\n  {line}  # sizes\n")
    _, (found,) = read_options(path)
    assert str(found).startswith(f"{path}:2:3: error[bad-proto]: {finding}")


def test_options_of_no_effect_on_sizes_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "a.options"
    path.write_text('* long_names:false packed_struct:true include:"x.h"\n')
    options, findings = read_options(path)
    assert findings == []
    assert options.of("A", "x") == NO_OPTIONS


def test_file_that_is_no_text_is_a_finding(tmp_path: Path) -> None:
    path = tmp_path / "a.options"
    path.write_bytes(b"\xff\xfe")
    _, (found,) = read_options(path)
    assert found.code is Code.BAD_FILE
