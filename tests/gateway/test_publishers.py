"""Which type and QoS a topic is followed with, given its publishers."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from hypothesis import given
from hypothesis import strategies as st

from router.gateway.publishers import Selection, select
from router.ros.topics import DiscoveredPublisher

RELIABLE = DiscoveredPublisher("a/msg/A", is_reliable=True, keeps=False, is_ours=False, gid=b"one")
LATCHED = RELIABLE._replace(keeps=True)
LOSSY = RELIABLE._replace(is_reliable=False)
LOSSY_LATCHED = LATCHED._replace(is_reliable=False)
OTHER = RELIABLE._replace(type_name="b/msg/B")
THIRD = RELIABLE._replace(type_name="c/msg/C")

FLAG = st.booleans()
seen = st.builds(DiscoveredPublisher, st.sampled_from("abc"), FLAG, FLAG, FLAG, st.binary(max_size=1))


@pytest.mark.parametrize(
    ("publishers", "is_reliable", "keeps"),
    [
        ([RELIABLE], True, False),
        ([LATCHED], True, True),
        ([LOSSY], False, False),
        ([LOSSY_LATCHED], False, False),
        ([RELIABLE, LATCHED], True, False),
        ([LATCHED, LATCHED], True, True),
        ([LATCHED, LOSSY], False, False),
        ([LATCHED, LATCHED, OTHER._replace(is_reliable=False)], True, True),
    ],
)
def test_quality_is_what_every_publisher_of_the_type_offers(
    publishers: list[DiscoveredPublisher], is_reliable: bool, keeps: bool
) -> None:
    chosen = select(publishers, is_inbound=False)
    assert chosen
    assert (chosen.is_reliable, chosen.keeps) == (is_reliable, keeps)


def test_the_type_of_the_table_is_served_if_it_has_a_publisher() -> None:
    publishers = [OTHER, OTHER, RELIABLE]
    expected = Selection("a/msg/A", is_reliable=True, keeps=False, others=("b/msg/B",))
    assert select(publishers, is_inbound=False, table_type="a/msg/A") == expected
    served = select(publishers, is_inbound=False, table_type="c/msg/C")
    assert served
    assert served.type_name == "b/msg/B"  # for the state `refused`, with a reason


@pytest.mark.parametrize(
    ("publishers", "type_name", "others"),
    [
        ([RELIABLE], "a/msg/A", ()),
        ([RELIABLE, OTHER, OTHER], "b/msg/B", ("a/msg/A",)),
        ([OTHER, RELIABLE], "a/msg/A", ("b/msg/B",)),
        ([OTHER, THIRD, THIRD, RELIABLE], "c/msg/C", ("a/msg/A", "b/msg/B")),
    ],
)
def test_the_type_of_most_publishers_is_served(
    publishers: list[DiscoveredPublisher], type_name: str, others: tuple[str, ...]
) -> None:
    assert select(publishers, is_inbound=False) == Selection(type_name, is_reliable=True, keeps=False, others=others)


def test_those_that_keep_messages_are_known_also_among_others() -> None:
    second, other = LATCHED._replace(gid=b"two"), RELIABLE._replace(gid=b"three")
    all_keep = select([LATCHED, second], is_inbound=False)
    mixed = select([LATCHED, second, other, LOSSY_LATCHED._replace(gid=b"four")], is_inbound=False)
    none = select([other], is_inbound=False)
    assert all_keep and mixed and none  # noqa: PT018
    assert (all_keep.keepers, all_keep.is_mixed) == (frozenset({b"one", b"two"}), False)
    assert (mixed.keepers, mixed.is_mixed) == (frozenset({b"one", b"two"}), True)
    assert (none.keepers, none.is_mixed) == (frozenset(), False)


def test_a_topic_without_publishers_is_not_served() -> None:
    assert select([], is_inbound=False) is None


def test_our_own_publishers_count_unless_the_topic_is_let_in() -> None:
    ours = OTHER._replace(is_ours=True)
    routed, let_in = select([ours], is_inbound=False), select([ours, ours, RELIABLE], is_inbound=True)
    assert routed
    assert routed.type_name == "b/msg/B"
    assert let_in == Selection("a/msg/A", is_reliable=True, keeps=False, others=())
    assert select([ours], is_inbound=True) is None


@given(st.lists(seen), st.booleans())
def test_the_order_in_which_publishers_were_found_does_not_matter(
    publishers: list[DiscoveredPublisher], is_let_in: bool
) -> None:
    assert select(publishers, is_inbound=is_let_in) == select(sorted(publishers), is_inbound=is_let_in)
