"""The expressions of a table, in the syntax of Python: checked and typed.

`checker` walks an expression, applies the rules of the modules beside it, and returns a `tree`. `conversion` checks
whether the value fits the field that it fills.
"""

from __future__ import annotations

from router.compiler.expressions.checker import DEEPEST, check
from router.compiler.expressions.scope import ExpressionError, Scope

__all__ = ["check", "ExpressionError", "Scope", "DEEPEST"]
