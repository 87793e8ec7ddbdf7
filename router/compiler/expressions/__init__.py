"""The expressions of a table: a closed subset of Python, checked, typed and turned into Python syntax.

`checker` walks an expression and applies the rules of the modules beside it. Whether the value fits the field that it
fills is checked in `conversion`.
"""

from __future__ import annotations

from router.compiler.expressions.checker import DEEPEST, check
from router.compiler.expressions.scope import ExpressionError, ParsedReads, Reads, Scope, Typed

__all__ = ["check", "ExpressionError", "Typed", "Scope", "Reads", "ParsedReads", "DEEPEST"]
