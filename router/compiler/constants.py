"""Payloads of constants: what deadmen send in place of commands."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from typing import Any

from google.protobuf.message import Message

from router.compiler.expressions.tree import Node
from router.compiler.namespace import NAMESPACE, fit_length
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.compiler.python import render
from router.errors import MappingError
from router.types.model import Float
from router.types.protobuf import PayloadCase
from router.types.wire import delimited

_Variables = Mapping[str, object]


def constant_envelope(plan: Record, case: PayloadCase) -> bytes:
    """The envelope of a plan whose expressions read no message.

    Raises MappingError or ValueError when it cannot be built.
    """
    payload = case.message_class()
    try:
        _fill(payload, plan, {})
    except (ArithmeticError, LookupError) as error:
        raise MappingError(str(error)) from error
    return delimited(case.number, payload.SerializeToString())


def _fill(message: Message, plan: Record, variables: _Variables) -> None:
    for member, made in plan.members:
        match made:
            case Leaf():
                setattr(message, member.name, _leaf(made, variables))
            case Record():
                inner = getattr(message, member.name)
                inner.SetInParent()
                _fill(inner, made, variables)
            case Items():
                for element in made.items:
                    _add(getattr(message, member.name), element, variables)
            case Each():
                _add_each(getattr(message, member.name), made, variables)
            case Unset():
                pass


def _add(repeated: Any, element: Plan, variables: _Variables) -> None:
    """Append an element, or set an entry of a map: of two with the same key the later one stays."""
    match element:
        case Leaf():
            repeated.append(_leaf(element, variables))
        case Record() if element.type.is_map_entry:
            plans = {member.name: made for member, made in element.members}
            key, value = _leaf(plans["key"], variables), plans["value"]
            if isinstance(value, Record):
                repeated[key].Clear()
                _fill(repeated[key], value, variables)
            else:
                repeated[key] = _leaf(value, variables)
        case Record():
            _fill(repeated.add(), element, variables)


def _add_each(repeated: Any, each: Each, variables: _Variables) -> None:
    names, values = zip(*((name, _value(node, variables)) for name, node in each.lists), strict=True)
    length, bound = each.type.length, each.type.bound
    if length is not None:
        fit_length(values[0], length, length)
    elif bound is not None:
        fit_length(values[0], 0, bound)
    for elements in zip(*values, strict=True):
        _add(repeated, each.element, {**variables, **dict(zip(names, elements, strict=True))})


def _leaf(plan: Plan, variables: _Variables) -> Any:
    assert isinstance(plan, Leaf)  # noqa: S101 - where a scalar is filled
    value = _value(plan.node, variables)
    return NAMESPACE["float32"](value) if plan.type == Float(32) else value  # type: ignore[operator]  # it is a function


def _value(node: Node, variables: _Variables) -> Any:
    made = ast.fix_missing_locations(ast.Expression(render(node)))
    return eval(compile(made, "a constant", "eval"), {**NAMESPACE, **variables})  # noqa: S307 - of a checked expression
