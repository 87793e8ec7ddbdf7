"""Topics by globs, as gateways have them: `*` within a part of a name, `**` any parts, `?` one character."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from router.compiler.selection import pattern_problem
from router.errors import SourceSpan
from router.table.model import TopicPattern
from router.tools import UsageError

_COMMAND_LINE = SourceSpan("command line", 1, 1)

_WILDCARD = re.compile(r"/\*\*|/\*(?=/|$)|\*|\?")
_MEANING = {"/**": r"(?:/[^/]+)*", "/*": r"/[^/]+", "*": r"[^/]*", "?": r"[^/]"}
_BELOW = r"(?:/[^/]+)+"


def topic_filter(globs: Sequence[str]) -> Callable[[str], bool]:
    """Whether any of them matches a topic; without globs each topic does. Raises UsageError."""
    for glob in globs:
        problem = pattern_problem(TopicPattern(glob, is_regex=False, span=_COMMAND_LINE))
        if problem is not None:
            raise UsageError(f"--topic: {problem.what}; {problem.hint}")
    matching = re.compile("|".join(map(_regex, globs)) if globs else ".*", re.DOTALL)
    return lambda topic: matching.fullmatch(topic) is not None


def _regex(glob: str) -> str:
    def meaning(wildcard: re.Match[str]) -> str:
        is_last = wildcard[0] == "/**" and wildcard.end() == len(glob)
        return _BELOW if is_last else _MEANING[wildcard[0]]

    return _WILDCARD.sub(meaning, glob)
