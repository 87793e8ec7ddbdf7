"""What each verb says of a table that has `gateways` only."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main

TABLE = """\
version: 1
gateways:
  headset: {transport: {udp: 127.0.0.9:8502}}
"""
NO_ENVELOPE = "only.yaml has no 'envelope': there are no datagrams to build or to read\n"


@pytest.fixture(autouse=True)
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "only.yaml"
    path.write_text(TABLE)
    return path


def test_verbs_about_the_table_show_the_gateway_and_nothing_that_it_does_not_have(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["validate", "--strict", "only.yaml"]) == OK
    assert capsys.readouterr().out == "only.yaml: ok (1 gateway)\n"
    assert main(["explain", "--table", "only.yaml"]) == OK
    assert capsys.readouterr().out.startswith("headset: gateway, udp to 127.0.0.9:8502")
    for name in ("map.svg", "map.mmd", "map.dot"):
        assert main(["graph", "only.yaml", "-o", name]) == OK
        assert "headset" in Path(name).read_text()
    main(["doctor", "-t", "only.yaml"])
    said = capsys.readouterr().out
    assert "only.yaml: 1 gateway\n" in said
    assert "buffers" not in said
    assert "ports" not in said


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["send", "imu_info", "--to", "127.0.0.1:5000", "--table", "only.yaml"], NO_ENVELOPE),
        (["tap", "--table", "only.yaml", "--url", "http://127.0.0.1:9"], NO_ENVELOPE),
        (["listen", "envelope://5000", "--table", "only.yaml"], NO_ENVELOPE),
        (["sim", "-t", "only.yaml", "--for", "1s"], "only.yaml has no listeners"),
        (
            ["new", "SensorBoardDose", "--number", "99", "--board", "s", "--table", "only.yaml"],
            "only.yaml has no 'envelope' that a message could be added to",
        ),
    ],
)
def test_what_is_about_datagrams_says_that_there_are_none(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == BAD_USAGE
    assert complaint in capsys.readouterr().err


def test_there_is_nothing_to_test(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["test", "."]) == BAD_USAGE
    assert "no tests (*.test.yaml)" in capsys.readouterr().err
    (tmp_path / "only.test.yaml").write_text("tests: {a: {given: {case: ph_info, from: any}, expect: nothing}}\n")
    assert main(["test", "."]) == BAD_TABLE
    said = capsys.readouterr().err
    assert "only.test.yaml:1:1: error[bad-file]: only.yaml has no routes\n" in said
    assert "\nhelp: only routes are tested" in said
