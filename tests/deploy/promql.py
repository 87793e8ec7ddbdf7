"""Finds the series selectors in a PromQL expression. Parses only the necessary grammar and refuses the rest."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

_TOKEN = re.compile(
    r"""\s+ | (?P<string>"(?:\\.|[^"\\])*") | (?P<range>\[[\w$:.]+\])
    | (?P<number>\d+(?:\.\d+)?(?:[eE][+-]?\d+)?(?:[smhdwy]|ms)?\b) | (?P<name>[A-Za-z_:][\w:]*)
    | (?P<sign>=~|!~|!=|==|<=|>=|[-+*/%^<>=(){},])""",
    re.VERBOSE,
)
_OPERATORS = {"and", "or", "unless", "bool", "offset"}
_LABEL_LISTS = {"by", "without", "on", "ignoring", "group_left", "group_right"}
_MATCHES: Mapping[str, Callable[[str, str], bool]] = {
    "=": lambda pattern, value: value == pattern,
    "!=": lambda pattern, value: value != pattern,
    "=~": lambda pattern, value: re.fullmatch(pattern, value) is not None,
    "!~": lambda pattern, value: re.fullmatch(pattern, value) is None,
}


class NotUnderstoodError(Exception):
    """The expression uses PromQL that this parser does not support."""


@dataclass(frozen=True)
class Selector:
    """`router_unhandled_total{payload_case="imu_info"}`: a metric and conditions for its labels."""

    metric: str
    matchers: tuple[tuple[str, str, str], ...] = ()

    def selects(self, metric: str, labels: Mapping[str, str], added: Iterable[str] = ("instance", "job")) -> bool:
        """Whether the selector matches this series, before Prometheus adds its own labels."""
        return metric == self.metric and all(
            _MATCHES[sign](value, labels.get(label, "")) for label, sign, value in self.matchers if label not in added
        )


def selectors(expression: str) -> list[Selector]:
    """All selectors of an expression. Raises NotUnderstoodError."""
    tokens = list(_tokens(expression))
    found, index = [], 0
    while index < len(tokens):
        kind, text = tokens[index]
        follows = tokens[index + 1][1] if index + 1 < len(tokens) else ""
        index += 1
        if text == "{":
            raise NotUnderstoodError(f"a selector without a metric: {expression}")
        if kind != "name" or text in _OPERATORS:
            continue
        if text in _LABEL_LISTS:
            index = tokens.index(("sign", ")"), index) + 1
        elif follows == "{":
            end = tokens.index(("sign", "}"), index)
            found.append(Selector(text, tuple(_matchers(tokens[index + 1 : end]))))
            index = end + 1
        elif follows != "(" and follows not in _LABEL_LISTS:
            found.append(Selector(text))
    return found


def grouping_labels(expression: str) -> set[str]:
    """All labels in `by (...)`, `on (...)` and similar clauses."""
    tokens, found = list(_tokens(expression)), set()
    for index, (_, text) in enumerate(tokens):
        if text in _LABEL_LISTS:
            end = tokens.index(("sign", ")"), index)
            found |= {word for kind, word in tokens[index + 1 : end] if kind == "name"}
    return found


def _tokens(expression: str) -> Iterable[tuple[str, str]]:
    position = 0
    while position < len(expression):
        match = _TOKEN.match(expression, position)
        if match is None:
            raise NotUnderstoodError(f"not understood: {expression[position:]}")
        position = match.end()
        if match.lastgroup:
            yield match.lastgroup, match[0]


def _matchers(tokens: list[tuple[str, str]]) -> Iterable[tuple[str, str, str]]:
    while tokens:
        matcher, comma, tokens = tokens[:3], tokens[3:4], tokens[4:]
        texts = [text for _, text in matcher]
        kinds = [kind for kind, _ in matcher]
        if kinds != ["name", "sign", "string"] or texts[1] not in _MATCHES or comma not in ([], [("sign", ",")]):
            raise NotUnderstoodError(f"no matcher: {' '.join(texts)}")
        yield texts[0], texts[1], json.loads(texts[2])
