from __future__ import annotations

import pytest

from router.tools import UsageError
from router.tools.listening_topics import topic_filter


@pytest.mark.parametrize(
    ("glob", "matched", "others"),
    [
        ("/imu", ["/imu"], ["/imu/data", "/a/imu", "imu"]),
        ("/a/*", ["/a/b"], ["/a", "/a/", "/a/b/c"]),
        ("/a/**", ["/a/b", "/a/b/c"], ["/a", "/ab/c"]),
        ("/**/imu", ["/imu", "/a/imu", "/a/b/imu"], ["/imu/a", "/aimu"]),
        ("/*/b", ["/a/b"], ["/b", "/a/a/b"]),
        ("/a*/b?", ["/a/b1", "/ab/b2"], ["/a/b", "/a/b12", "/a/c/b1"]),
        ("/**", ["/a", "/a/b"], [""]),
    ],
)
def test_a_glob_matches_parts_of_names(glob: str, matched: list[str], others: list[str]) -> None:
    wants = topic_filter([glob])
    assert list(filter(wants, matched)) == matched
    assert list(filter(wants, others)) == []


def test_one_of_several_globs_is_enough_and_none_means_all() -> None:
    wants = topic_filter(["/a", "/b/*"])
    assert [wants(topic) for topic in ("/a", "/b/c", "/c", "/b")] == [True, True, False, False]
    assert topic_filter([])("any\nthing")


def test_what_is_no_glob_is_refused() -> None:
    with pytest.raises(UsageError, match=r"--topic: 'imu' does not begin with '/'; .*did you mean '/imu'"):
        topic_filter(["/a", "imu"])
