"""The lengths of lists that `router sim` sends: mappings get what they need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from router.compiler import check_table
from router.errors import Severity
from router.tools.lengths import needed_lengths
from router.tools.payloads import PayloadModel, pose

PROTO = """
syntax = "proto3";
message Cell { uint32 mv = 1; repeated double cov = 2; bytes id = 3; }
message Pack { repeated Cell cells = 1; repeated float mas = 2; repeated float others = 3; bool flag = 4; }
message Power { Pack pack = 1; repeated double more = 2; repeated string names = 3; }
message PBEnvelope { oneof payload { Power power = 1; } }
"""
TABLE = """\
version: 1
envelope: {{protos: protos, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: "127.0.0.1:5000"}}}}
endpoints: {{station: {{address: "127.0.0.2:8", kind: tool}}, base: {{address: "127.0.0.3:8", kind: tool}}}}
routes:
  power:
    source: station
    destinations: {{endpoint: base, when: "{when}"}}
    topic: {{topic: it, type: {type}, fields: {{{fields}}}}}
"""
ARRAY = "std_msgs/msg/Float64MultiArray"
POSE = "geometry_msgs/msg/PoseWithCovariance"
ID = "unique_identifier_msgs/msg/UUID"


@pytest.mark.parametrize(
    ("type_", "fields", "when", "lengths"),
    [
        (ARRAY, "data: more", "true", {"more": 3}),
        (ARRAY, "data: more", "more[6] > 0 or more[4] > 0", {"more": 7}),
        (ARRAY, "data: more", "'x' in names and more[0] > 0", {"more": 3, "names": 3}),
        (ARRAY, "data: pack.cells.mv / 1000", "pack.cells[4].mv > 0", {"cells": 5}),
        (ARRAY, "data: pack.cells.mv * pack.mas", "pack.mas[3] > 0", {"cells": 4, "mas": 4}),
        (ARRAY, "data: pack.mas if pack.flag else pack.others", "pack.mas[4] > 0", {"mas": 5, "others": 5}),
        (ARRAY, "data: more", "sum(pack.mas + pack.others) > pack.others[3]", {"mas": 4, "others": 4, "more": 3}),
        (ARRAY, "data: more", "len(pack.cells[1].cov) > 0", {"cells": 3, "cov": 3}),
        (POSE, "covariance: more", "true", {"more": 36}),
        (POSE, "covariance: 'pack.cells[3].cov'", "true", {"cells": 4, "cov": 36}),
        (ID, "uuid: 'pack.cells[0].id'", "true", {"cells": 3, "id": 16}),
    ],
)
def test_lists_have_the_length_that_mappings_need(
    tmp_path: Path, type_: str, fields: str, when: str, lengths: dict[str, int]
) -> None:
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "envelope.proto").write_text(PROTO)
    (tmp_path / "table.yaml").write_text(TABLE.format(type=type_, fields=fields, when=when))
    checked = check_table(tmp_path / "table.yaml", {})
    assert [each for each in checked.diagnostics if each.severity is Severity.ERROR] == []
    assert checked.envelopes is not None
    case = checked.envelopes.first.cases["power"]
    message: Any = case.message_class()
    PayloadModel(case.name, case.type, 1, needed_lengths(checked.routes)).fill(message, pose(1.0, 0.0))
    cell = message.pack.cells[0]
    found = {"more": message.more, "names": message.names, "cells": message.pack.cells, "mas": message.pack.mas}
    found |= {"others": message.pack.others, "cov": cell.cov, "id": cell.id}
    assert {name: len(found[name]) for name in lengths} == lengths
