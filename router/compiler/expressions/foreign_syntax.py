"""Hints for expressions in the syntax of other languages."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import NamedTuple

CONDITIONAL = "write `b if a else c`"
LEFT_OUT = (
    "to keep a default, omit the field; to test whether a field is set, write has(x); to withhold a message, use `when`"
)
ARRIVAL = "write received_at, the time of arrival"
INTEGERS = "convert it with round(x), trunc(x), floor(x) or ceil(x)"
WRAPPED = "convert it with round(x), or wrap a float with x % 360"
DECIMALS = "write text(x, 2) for two decimals"
POWER = "write x ** 2"
SQUARE = "for a square, write x ** 2; for exclusive or, a != b"
SHIFT = "write x * 2 ** 3 for x << 3, x // 2 ** 3 for x >> 3"
BITS = "there are no bit operations; use `{}` for bools"
FLOAT = "write float64(x), or float32(x)"

_SYNTAX = (
    (r"\?\?", "write `x if has(x) else y` for `x ?? y`"),
    (r"\?\.", LEFT_OUT),
    (r"\?", f"{CONDITIONAL} for `a ? b : c`"),
    (r"&&", "write `and` for `&&`"),
    (r"\|\|", "write `or` for `||`"),
    (r"===", "write `==`"),
    (r"=!", "write `!=`"),
    (r"=>", "write `>=`"),
    (r"->", "write `.` for `->`"),
    (r"(?-i:\b(?:AND|OR|NOT)\b)", "write and, or, not in lower case"),
    ("\u00b2", "write `** 2` for a square"),
    ("\u00b3", "write `** 3` for a cube"),
    (r"<>", "write `!=`"),
    (r"!(?!=)", "write `not` for `!`"),
    (r"::", "write `.` for `::`; functions have no namespace"),
    (r"<\w+>\s*\(|\((?:unsigned )?(?:float|double|int|u?int\d+_t)\)\s*\w", f"{FLOAT}, round(x) or int(x) for a cast"),
    (r"\d[fFuUlL]\b", "write the number without its suffix"),
    (r"^\s*return\b", "write the value alone, without `return`"),
    (r"//.*\w\s+\w", "start a comment with `#`, after a space and outside quotes"),
    (r";\s*$", "remove the `;`"),
    ("[\u00d7\u00b7]", "write `*`"),
    ("[\u2212\u2013]", "write `-`"),
    (r"^\s*if\b", f"{CONDITIONAL} for `if a then b else c`"),
    (r"\bif\b(?!.*\belse\b)", CONDITIONAL),
    (r"(?<![<>=!])=(?!=)", "use `==` to compare; expressions cannot assign"),
    (r"^\s*[-+]?\.(?:nan|inf)\s*$", "write nan, inf or -inf"),
    (r"\$\w", "write the field's name without `$`"),
    (r"^[^(]*\)", "remove the closing bracket, or open it"),
    (r"\w\s+\w", "add the missing operator, or the brackets of a function: abs(x)"),
)
"""Patterns to search, in this order, in an expression that Python cannot parse."""

_UNIT = re.compile(
    r"(?<=[\w)\]])\s*(?P<unit>%|\u2030|\u00b0[CF]?|(?<![A-Za-z_])(?:k?m/h|m/s(?:\^?2|\u00b2)?|rad/s|deg/s|[kMG]?Hz|rpm|[mcdk]?m|[mu\u00b5n]?s|min|h"
    r"|degrees|degree|deg|rad|(?:milli|centi|kilo)?met(?:er|re)s?|seconds?|minutes?|hours?|volts?|amperes?|percent|hertz|[mk]?V|m?A|k?W|Nm|N|k?g|h?k?Pa|m?bar|lx|[um\u00b5]?T|[kM]i?B|ppm))"
    r"(?=\s*(?:$|[-+*/),\]<>=]|(?:if|else|and|or|in)\b))"
)
_WITHOUT_VALUE = re.compile(
    r"(?P<sign>(?<![-+*/%<>=!&|^])[-+*/%<>=!&|^]+(?=\s*(?:$|[),\]]|(?:and|or|if|else)\b))|\b(?:and|or|not|in|is|if|else)$)"
)


class Slip(NamedTuple):
    """A mistake that makes an expression invalid: its span (start, end), message and hint."""

    span: tuple[int, int]
    what: str
    hint: str


def slip(text: str, names: Collection[str]) -> Slip | None:
    """Find a unit that is not in `names`, or an operator without an operand, in invalid text. Return None without."""
    bare = _QUOTED.sub(lambda quoted: "_" * len(quoted[0]), text)
    if curly := _CURLY.search(bare):
        quote = "'" if curly[0] in _SINGLE else '"'
        is_all = len(_CURLY.split(text)) == 3 and not _CURLY.sub(" ", text[:1] + text[-1:]).strip()
        hint = f"for text, write {{text: {text[1:-1]}}}" if is_all else f"replace it with {quote}, at both ends"
        return Slip(curly.span(), f"'{curly[0]}' is a typographic quote", hint)
    for number in _UNIT.finditer(bare):
        unit = number["unit"]
        if unit not in names:
            value = _word_before(bare[: number.start()]) or "x"
            hint = "remove it, and write the value in the field's unit"
            hint = f"write radians({value})" if unit in _DEGREES else hint
            hint = f"write {value} / 100 for a fraction" if unit == "%" else hint
            return Slip(number.span("unit"), f"'{unit}' is a unit, which expressions do not support", hint)
    if every := _EVERY_ELEMENT.search(bare):
        hint = f"without brackets, {every['list']} means every element; {every['list']}[0] is the first one"
        return Slip(every.span("index"), f"'{every['index']}' names no element", hint)
    if sign := _WITHOUT_VALUE.search(bare):
        return Slip(sign.span("sign"), f"a value is missing after '{sign['sign']}'", "")
    return None


def _word_before(text: str) -> str:
    """Return the name or number at the end of a text; searched backwards, so that the time is linear."""
    word = re.match(r"[\w.]*", text[::-1])
    return word[0][::-1] if word else ""


_DEGREES = ("degrees", "degree", "deg", "\u00b0")
_SINGLE = "\u2018\u2019\u201a\u201b\u2032"
_CURLY = re.compile(f"[{_SINGLE}\u201c-\u201f\u2033\u00ab\u00bb]")
_EVERY_ELEMENT = re.compile(r"\b(?P<list>[A-Za-z_][\w.]*)(?P<index>\[\s*\*?\s*\])")
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")

NULLS = ("null", "nil", "none", "undefined", "nullptr")
NAMES = {
    **dict.fromkeys(NULLS, LEFT_OUT),
    **dict.fromkeys(("pi", "m_pi"), "write 3.141592653589793; radians(x) and degrees(x) convert angles"),
    **dict.fromkeys(("now", "time", "stamp", "timestamp"), ARRIVAL),
    **dict.fromkeys(("infinity", "infinityf"), "write inf"),
    **dict.fromkeys(("yes", "on"), "write true"),
    **dict.fromkeys(("no", "off"), "write false"),
    "static_cast": FLOAT,
    "header": ARRIVAL,
}
"""Hints for names, in lower case, that expressions do not have."""

FUNCTIONS = {
    **dict.fromkeys(("pow", "square", "sqr"), POWER),
    "fabs": "write abs(x)",
    "mod": "write x % y",
    "fmod": "write x % y",
    "float": FLOAT,
    "double": "write float64(x)",
    "isnan": "to test for NaN, write x != x",
    "sign": "write 1 if x > 0 else -1 if x < 0 else 0",
    "atan": "write atan2(y, x)",
    "asin": "write atan2(x, sqrt(1 - x * x))",
    "acos": "write atan2(sqrt(1 - x * x), x)",
    "map": "for a field of each element, write x.y; to choose a value, write {map: FIELD, VALUE: ..., else: ...}",
    **dict.fromkeys(("size", "length", "count"), "write len(x)"),
    "received_at": "write it without brackets",
    "range": "compare: 0 <= x < 3",
    "list": "leave it out: fields and [a, b] are lists",
    "tofixed": DECIMALS,
    "bool": "compare: x != 0",
    "constrain": "write clamp(x, low, high)",
    **dict.fromkeys(("rad", "deg2rad", "to_radians", "degtorad"), "write radians(x)"),
    **dict.fromkeys(("deg", "rad2deg", "to_degrees", "radtodeg"), "write degrees(x)"),
    **dict.fromkeys(("hasfield", "has_field", "exists", "defined", "isset", "is_set", "is_present"), "write has(x)"),
    "to_string": "write str(x), or text(x, 2) for decimals",
    **dict.fromkeys(("avg", "mean", "average"), "write sum(x) / len(x)"),
    **dict.fromkeys(("any", "all"), "write `value in x`, or compare min(x) or max(x)"),
    "now": ARRIVAL,
    "time": ARRIVAL,
}
"""Hints for functions by their names in other languages, in lower case, without a module's name."""


def of_syntax(text: str) -> str:
    """Return a hint for an expression that cannot be parsed; empty if there is none."""
    bare = _QUOTED.sub("", text)
    if bare.count("(") > bare.count(")"):
        return "close every bracket; inside {} and [] quote the expression, because a comma ends it"
    return next((hint for pattern, hint in _SYNTAX if re.search(pattern, bare, re.IGNORECASE)), "")
