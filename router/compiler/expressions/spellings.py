"""What to write here for what other languages spell otherwise: hints of findings."""

from __future__ import annotations

import re

CONDITIONAL = "write `b if a else c`"
LEFT_OUT = "a field that is left out keeps its default; `when` keeps a message from being sent"
ARRIVAL = "write received_at, the time of arrival"
INTEGERS = "round(x), trunc(x), floor(x) and ceil(x) make an integer of it"
POWER = "write x ** 2"

_SYNTAX = (
    (r"\?", f"{CONDITIONAL} for `a ? b : c`"),
    (r"&&", "write `and` for `&&`"),
    (r"\|\|", "write `or` for `||`"),
    (r"!(?!=)", "write `not` for `!`"),
    (r"^\s*if\b", f"{CONDITIONAL} for `if a then b else c`"),
    (r"\bif\b(?!.*\belse\b)", CONDITIONAL),
    (r"(?<![<>=!])=(?!=)", "`==` compares; an expression assigns nothing"),
    (r"^\s*[-+]?\.(?:nan|inf)\s*$", "write nan, inf or -inf"),
    (r"\$\w", "write the field's name without `$`"),
    (r"\w\s+\w", "an operator is missing there, or the brackets of a function: abs(x)"),
)
"""What to search in an expression that Python cannot parse, in this order."""

_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")

NAMES = {
    **dict.fromkeys(("null", "nil", "NULL", "undefined"), LEFT_OUT),
    "pi": "write 3.141592653589793; radians(x) and degrees(x) turn angles",
    "now": ARRIVAL,
    "time": ARRIVAL,
}
"""Names that are neither fields nor constants."""

FUNCTIONS = {
    "pow": POWER,
    "square": POWER,
    "fabs": "write abs(x)",
    "mod": "write x % y",
    "fmod": "write x % y",
    "float": "write float64(x), or float32(x)",
    "double": "write float64(x)",
    "bool": "compare: x != 0",
    "constrain": "write clamp(x, low, high)",
    "rad": "write radians(x)",
    "deg2rad": "write radians(x)",
    "deg": "write degrees(x)",
    "rad2deg": "write degrees(x)",
    "to_string": "write str(x)",
    "now": ARRIVAL,
    "time": ARRIVAL,
}
"""Functions by their names elsewhere, after the module's name where there is one."""


def of_syntax(text: str) -> str:
    """The hint for an expression that cannot be parsed; empty where it looks like nothing known."""
    bare = _QUOTED.sub("", text)
    if bare.count("(") > bare.count(")"):
        return "close every bracket; inside {} and [] quote the expression, or a comma ends it"
    return next((hint for pattern, hint in _SYNTAX if re.search(pattern, bare, re.IGNORECASE)), "")
