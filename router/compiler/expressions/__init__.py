"""The expressions of a table, in the syntax of Python: checked and typed.

`checker` walks an expression and applies the rules of the modules beside it. What comes out is a `tree`. Whether the
value fits the field that it fills is checked in `conversion`.
"""

from __future__ import annotations

from router.compiler.expressions.checker import DEEPEST, check
from router.compiler.expressions.scope import ExpressionError, Scope

__all__ = ["check", "ExpressionError", "Scope", "DEEPEST"]
