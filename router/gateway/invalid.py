"""What is wrong with a message that a client sent, and where in it. Knows no type and no format."""

from __future__ import annotations

_MOST_SHOWN = 60
"""Characters of a client's text that are repeated to it."""


class InvalidMessageError(ValueError):
    """A message that is no JSON, or not one of its type. Its text is one short sentence, with the place first."""

    def __init__(self, reason: str, path: str = "") -> None:
        super().__init__(f"{path}: {reason}" if path else reason)
        self.reason = reason
        self.path = path

    def inside(self, holder: str) -> InvalidMessageError:
        """The same, seen from the message or list that has the blamed value in `holder`: a name, or `[3]`."""
        dot = "." if self.path and not self.path.startswith("[") else ""
        return InvalidMessageError(self.reason, f"{holder}{dot}{self.path}")


def shown(value: object) -> str:
    """A value of a client's in the words of JSON, cut short; safe in a line of a log."""
    match value:
        case None | bool():
            return {None: "null", False: "false", True: "true"}[value]
        case str():
            text = repr(value[:_MOST_SHOWN])
            return text if len(value) < _MOST_SHOWN >= len(text) else f"{text[:_MOST_SHOWN]}..."
        case int() if value.bit_length() > 128:
            return "a huge number"
        case int() | float():
            return str(value)
        case list():
            return "a list"
        case _:
            return "an object"
