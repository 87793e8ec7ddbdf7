"""Literals and lists, what is inside them, and what becomes a literal because literals are all that goes in."""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence

from router.compiler.expressions.forbidden import forbidden
from router.compiler.expressions.typed import Finding, Typed
from router.compiler.kinds import BoolKind, FloatKind, IntKind, Kind, ListKind, StringKind, join
from router.errors import Code, SourceSpan

WIDEST = 512
"""How many bits an integer may have on the way to a field."""


def constant(value: object, span: SourceSpan) -> Typed:
    match value:
        case bool():
            return Typed.at(span, BoolKind(), ast.Constant(value))
        case int():
            return Typed.at(span, within_bounds(IntKind(value, value), span), ast.Constant(value))
        case float():
            if not math.isfinite(value):
                raise Finding(span, Code.OUT_OF_RANGE, "a literal this large is infinite")
            return Typed.at(span, FloatKind(32), ast.Constant(value))
        case str():
            return Typed.at(span, StringKind(), ast.Constant(value))
        case _:
            raise forbidden(ast.Constant(None), span)


def within_bounds(kind: Kind, span: SourceSpan) -> Kind:
    """Keeps powers of powers from taking all memory, here and at run time."""
    if isinstance(kind, IntKind) and kind.bounds and max(bound.bit_length() for bound in kind.bounds) > WIDEST:
        raise Finding(span, Code.OUT_OF_RANGE, f"an integer has at most {WIDEST} bits")
    return kind


def folded(result: Typed) -> Typed:
    """Arithmetic of two literals is done here, so that what it comes to is checked against the target."""
    try:
        value = eval(compile(ast.Expression(result.node), "<literal>", "eval"), {})  # noqa: S307 - two literals
    except ArithmeticError as error:
        raise Finding(result.span, Code.OUT_OF_RANGE, str(error)) from None
    if isinstance(value, float) and not math.isfinite(value):
        raise Finding(result.span, Code.OUT_OF_RANGE, f"this is always {value}", f"write {value} if that is meant")
    kind = IntKind(value, value) if isinstance(value, int) else result.kind
    return Typed.at(result.span, kind, ast.Constant(value))


def list_of(items: Sequence[Typed], span: SourceSpan) -> Typed:
    element: Kind | None = items[0].kind if items else None
    for item in items[1:]:
        element = join(element, item.kind) if element else None
        if element is None:
            raise Finding(item.span, Code.TYPE_MISMATCH, f"a list of {items[0].kind} cannot hold {item.kind}")
    made = ast.List([item.node for item in items], ast.Load())
    return Typed.at(span, ListKind(element, len(items)), made, items=tuple(items))


def element_of(holder: Typed, index: Typed, span: SourceSpan) -> Typed:
    """`holder[index]`."""
    kind, position = holder.kind, index.constant
    if not isinstance(kind, ListKind) or kind.element is None:
        raise Finding(span, Code.TYPE_MISMATCH, f"a {kind} has no elements", "only lists are indexed")
    if not isinstance(position, int) or isinstance(position, bool) or position < 0:
        raise Finding(index.span, Code.FORBIDDEN_EXPRESSION, "an index is a literal integer from 0")
    if kind.length is not None and position >= kind.length:
        raise Finding(index.span, Code.OUT_OF_RANGE, f"index {position} of {kind.length} elements")
    return Typed.at(span, kind.element, ast.Subscript(holder.node, index.node, ast.Load()))
