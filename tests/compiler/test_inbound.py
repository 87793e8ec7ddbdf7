"""Routes from UDP: what expressions see of a frame that was put together of several datagrams."""

from __future__ import annotations

import pytest

from router.compiler import Checked
from router.errors import Code, Diagnostic
from tests.compiler.conftest import CheckText

ROUTE = """
routes:
  detected_object:
    source: base
    collect: {collect}
    topics: [{{topic: a, type: comms/msg/DetectedObjectArray, fields: {fields}}}]
"""
COLLECT = "{by: frame_id, count: total_count, order: index, timeout: 1s}"


def check(check_text: CheckText, collect: str = COLLECT, fields: str = "{detections: items}") -> Checked:
    return check_text(ROUTE.format(collect=collect, fields=fields))


def findings(checked: Checked) -> list[Diagnostic]:
    return [finding for finding in checked.diagnostics if finding.code is not Code.UNCOVERED_PAYLOAD_CASE]


def test_topics_see_all_parts_their_number_and_the_fields_of_the_first(check_text: CheckText) -> None:
    checked = check(check_text, fields="{frame_id: 'frame_id if count > 1 else items[0].frame_id', detections: items}")
    assert findings(checked) == []
    (target,) = checked.routes[0].targets
    assert [row.target for row in target.rows] == ["frame_id", "detections"]


def test_one_part_does_not_see_the_others(check_text: CheckText) -> None:
    checked = check(check_text, collect=COLLECT.replace("total_count", "count"))
    assert [(finding.code, finding.message) for finding in findings(checked)] == [
        (Code.UNKNOWN_FIELD, "BasestationDetectedObject has no field 'count'")
    ]


@pytest.mark.parametrize(
    ("key", "value", "is_fine"),
    [
        ("frame_id", "str(frame_id)", True),
        ("frame_id", "type", True),
        ("frame_id", "confidence > 0.5", True),
        ("frame_id", "confidence", False),
        ("frame_id", "bbox", False),
        ("total_count", "4", True),
        ("total_count", "confidence", False),
        ("index", "index - 1", True),
        ("index", "str(index)", False),
    ],
)
def test_frames_are_named_by_whole_values_and_ordered_by_integers(
    check_text: CheckText, key: str, value: str, is_fine: bool
) -> None:
    found = findings(check(check_text, collect=COLLECT.replace(f": {key}", f': "{value}"')))
    assert [finding.code for finding in found] == ([] if is_fine else [Code.TYPE_MISMATCH])
