"""Regular expressions that never go back: they match what Python's do, and are refused where they could not."""

from __future__ import annotations

import re
import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.automaton import MOST_STATES, Automaton, UnsupportedError

LEAF = st.sampled_from(["a", "b", "/", ".", "[ab]", "[^a]", "[a-c_]", r"\d", r"\W", r"[\d/]", r"[^\w]", "", "()"])
REPEAT = st.sampled_from(["*", "+", "?", "*?", "+?", "??", "{2}", "{0,2}", "{2,}", "{1,3}?", "{0}"])


def _grown(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.one_of(
        st.tuples(inner, inner).map("".join),
        st.tuples(inner, inner).map("(?:{0[0]}|{0[1]})".format),
        st.tuples(inner, REPEAT).map("({0[0]}){0[1]}".format),
        st.tuples(inner, inner, inner).map("({0[0]}|{0[1]}|{0[2]})".format),
    )


PATTERN = st.recursive(LEAF, _grown, max_leaves=6)


@given(PATTERN, st.lists(st.text("abc/_1.", max_size=6), max_size=5))
def test_the_same_texts_match_as_with_python(pattern: str, texts: list[str]) -> None:
    automaton, python = Automaton(pattern), re.compile(pattern)
    assert [automaton.matches(text) for text in texts] == [bool(python.fullmatch(text)) for text in texts]


@given(st.text("ab(|)[]^-*+?{},12.$\\d", max_size=12), st.text("ab-1", max_size=6))
def test_what_python_refuses_is_refused_and_nothing_else_raises(pattern: str, text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            python = re.compile(pattern)
        except re.error:
            with pytest.raises(re.error):
                Automaton(pattern)
            return
        try:
            automaton = Automaton(pattern)
        except UnsupportedError:
            return
    assert automaton.matches(text) is bool(python.fullmatch(text))


@pytest.mark.parametrize("pattern", ["^/imu.*$", r"\A/imu.*\Z", "(?P<name>/imu).*", "/im[u].*"])
def test_what_says_that_the_whole_text_is_meant_changes_nothing(pattern: str) -> None:
    automaton = Automaton(pattern)
    assert automaton.matches("/imu_2")
    assert not automaton.matches("/arm/imu_2")


@pytest.mark.parametrize(
    ("pattern", "what"),
    [
        (r"(a)\1", "backreference"),
        (r"(a)?(?(1)b|c)", "backreference"),
        ("(?=a)a", "look ahead"),
        ("a(?<!b)", "look ahead"),
        ("a(?!b).*", "look ahead"),
        ("a$b", "anchor"),
        (r"\ba", "anchor"),
        ("(?i)a", "flags"),
        ("(?s:a)", "flags"),
        ("a" * (MOST_STATES + 1), "more than 256 characters"),
        ("(a{1,65535}){1,65535}", "more than 256 characters"),
        ("((ab){16}){9}", "more than 256 characters"),
    ],
)
def test_what_could_not_be_matched_at_once_is_said(pattern: str, what: str) -> None:
    with pytest.raises(UnsupportedError, match=what):
        Automaton(pattern)


@pytest.mark.parametrize(
    ("pattern", "is_match"),
    [
        ("/gw/([a-z]+)*x", False),
        ("(.*)*x", False),
        ("(a|a)*", True),
        ("(a|aa|.a)*x", False),
        (".*a" * 60, True),
        ("(a?){250}", True),
        ("(a*)*" * 50, True),
        ("(((){65535}){65535}|a)*", True),
    ],
)
def test_what_python_would_try_for_ever_is_known_at_once(pattern: str, is_match: bool) -> None:
    text = "/gw/" + "a" * 251 if pattern.startswith("/") else "a" * 250
    assert Automaton(pattern).matches(text) is is_match


def test_a_pattern_may_be_as_long_as_a_name() -> None:
    assert Automaton("a" * MOST_STATES).matches("a" * MOST_STATES)


def test_any_number_of_texts_may_be_asked_for() -> None:
    automaton = Automaton("(.|a|b)*(ab|b.)?[^c]{12}")
    texts = [f"{number:b}{chr(300 + number)}".replace("1", "a").replace("0", "b") * 3 for number in range(2000)]
    python = re.compile("(.|a|b)*(ab|b.)?[^c]{12}")
    assert all(automaton.matches(text) is bool(python.fullmatch(text)) for text in texts)
