"""The expressions of a table: a closed subset of Python, checked, typed and turned into Python syntax.

`checker` walks an expression and asks the modules beside it for the rules. None of them knows of the field that an
expression fills, but for the bounds that clamp() and wrap() take from it: whether a value fits is `conversion`'s.
"""

from __future__ import annotations

from router.compiler.expressions.checker import DEEPEST, check
from router.compiler.expressions.scope import ExpressionError, ParsedReads, Reads, Scope, Typed

__all__ = ["check", "ExpressionError", "Typed", "Scope", "Reads", "ParsedReads", "DEEPEST"]
