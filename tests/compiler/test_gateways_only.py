"""A table with `gateways` only: complete, without a word of datagrams."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.app.watching import watched_files
from router.compiler import Checked, check_table
from router.compiler.lookup import Definitions
from router.errors import Code, Diagnostic, Severity
from router.observe.route_map import route_map
from router.recording.mirror import Classifier
from router.tools.explain import diff
from tests.tables import PROTOS

ONLY = "version: 1\ngateways: {headset: {transport: {udp: 127.0.0.9:8502}}}\n"
ENVELOPE = f"envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}\n"
LISTEN = "listen: {rover: {address: 127.0.0.1:5000}}\n"
ROUTES = "routes: {ph_info: {source: any, topics: [{topic: ph, type: comms/msg/SensorBoardPHInfo, fields: auto}]}}\n"


def checked(folder: Path, text: str, name: str = "table.yaml", known: Definitions | None = None) -> Checked:
    path = folder / name
    path.write_text(text)
    return check_table(path, {}, known)


def errors(found: Checked) -> list[Diagnostic]:
    return [each for each in found.diagnostics if each.severity is Severity.ERROR]


def said(found: Checked) -> list[str]:
    return [str(finding) for finding in found.diagnostics]


def test_it_compiles_and_nothing_is_to_be_said_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(PROTOS)  # the lock here is none of its business
    found = checked(tmp_path, ONLY)
    assert said(found) == []
    program = found.program
    assert program is not None
    assert [plan.settings.name for plan in program.gateways] == ["headset"]
    assert (program.listeners, program.senders, dict(program.inbound), dict(program.outbound)) == ((), (), {}, {})
    assert watched_files(program.table) == [tmp_path / "table.yaml"]


def test_what_its_clients_may_publish_is_checked_as_anywhere(tmp_path: Path) -> None:
    inbound = "receive: 127.0.0.1:8500, inbound: [{topic: /cmd_vel, type: geometry_msgs/msg/%s}]"
    assert said(checked(tmp_path, ONLY.replace("8502}", "8502}, " + inbound % "Twist"))) == []
    [finding] = checked(tmp_path, ONLY.replace("8502}", "8502}, " + inbound % "Twirl")).diagnostics
    assert finding.code is Code.UNKNOWN_ROS_TYPE


def test_a_type_whose_source_is_here_but_not_built_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source = Path("schemas", "ours", "msg", "Lamp.msg")
    source.parent.mkdir(parents=True)
    source.write_text("bool is_on\n")
    inbound = "receive: 127.0.0.1:8500, inbound: [{topic: /lamp, type: ours/msg/Lamp}]"
    [finding] = checked(tmp_path, ONLY.replace("8502}", "8502}, " + inbound)).diagnostics
    assert finding.hint == "it is in schemas/ours/msg, but not built: build and source ours"


@pytest.mark.parametrize("envelope", [ENVELOPE, "extends: base.yaml\n"])
def test_an_envelope_that_nothing_uses_asks_for_no_routes(tmp_path: Path, envelope: str) -> None:
    (tmp_path / "base.yaml").write_text(ENVELOPE)
    assert said(checked(tmp_path, envelope + ONLY)) == []


def test_with_routes_it_is_a_table_as_any_other(tmp_path: Path) -> None:
    assert [each.code for each in checked(tmp_path, ONLY + ENVELOPE + LISTEN + ROUTES).diagnostics] == [
        Code.UNCOVERED_PAYLOAD_CASE
    ]
    lacking = {
        ONLY + ROUTES: ["envelope", "listen"],
        ONLY + ROUTES + LISTEN: ["envelope"],
        ONLY + ROUTES + ENVELOPE: ["listen"],
        ONLY + LISTEN: ["envelope", "routes"],
        ONLY + LISTEN + ENVELOPE: ["routes"],
        "version: 1\n" + ENVELOPE + LISTEN: ["routes"],
        "version: 1\n" + ROUTES: ["envelope", "listen"],
        "version: 1\n" + ENVELOPE: ["listen", "routes"],
        "version: 1\ngateways: {}\n": ["envelope", "listen", "routes"],
        "version: 1\n": ["envelope", "listen", "routes"],
    }
    for text, keys in lacking.items():
        found = checked(tmp_path, text)
        assert [each.message for each in errors(found)] == [f"the table lacks the key '{key}'" for key in keys]
        assert all("'gateways'" in each.hint for each in errors(found))
        assert found.program is None


def test_what_is_needed_is_asked_of_the_whole_table(tmp_path: Path) -> None:
    (tmp_path / "only.yaml").write_text(ONLY)
    [finding] = checked(tmp_path, "extends: only.yaml\n" + ENVELOPE + LISTEN + "routes: {}\n").diagnostics
    assert finding.code is Code.UNCOVERED_PAYLOAD_CASE
    found = checked(tmp_path, "extends: only.yaml\n" + ENVELOPE + ROUTES)
    assert [each.message for each in errors(found)] == ["the table lacks the key 'listen'"]


def test_a_mistake_in_it_is_found_all_the_same(tmp_path: Path) -> None:
    found = checked(tmp_path, ONLY.replace("udp", "upd") + "envelop: {protos: nowhere}\n")
    assert all(each.severity is Severity.ERROR for each in found.diagnostics)
    assert {each.code for each in found.diagnostics} >= {Code.UNKNOWN_KEY}
    assert found.program is None


def test_a_reload_reads_no_protos_for_it_and_those_of_the_next_table(tmp_path: Path) -> None:
    only = checked(tmp_path, ONLY).program
    assert only is not None
    routed = checked(tmp_path, ONLY + ENVELOPE + LISTEN + ROUTES, known=Definitions(only.protos)).program
    assert routed is not None
    assert len(routed.envelope.cases) == 26
    again = checked(tmp_path, ONLY, known=Definitions(routed.protos)).program
    assert again is not None
    assert not again.envelope.cases


def test_a_datagram_from_before_the_reload_has_no_payload(tmp_path: Path) -> None:
    program = checked(tmp_path, ONLY).program
    assert program is not None
    assert Classifier(program.envelope, program.table).payload("rover", b"\xca\x01\x02\x08\x01") is None


def test_what_it_does_otherwise_than_another_is_told(tmp_path: Path) -> None:
    only = checked(tmp_path, ONLY, "only.yaml")
    routed = checked(tmp_path, ONLY + ENVELOPE + LISTEN + ROUTES, "routed.yaml")
    told = "\n".join(diff(only, routed))
    assert "@@ listener rover\n+" in told
    assert "@@ route ph_info\n+ph_info: " in told
    assert "gateway headset\n-" not in told


def test_it_is_drawn(tmp_path: Path) -> None:
    table = checked(tmp_path, ONLY).table
    assert table is not None
    assert [node.part.name for node in route_map(table).nodes] == ["ROS topics", "headset", "clients of headset"]
