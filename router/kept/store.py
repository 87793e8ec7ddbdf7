"""The files of kept programs: found by command line and directory, written atomically, of their owner alone.

Imports only small modules, as `router run` uses it before it imports anything large.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from router.inputs import Plain


class Kept:
    """A file that is whole and whose inputs are unchanged.

    `parts` are plain values, as `marshal` takes them. `image` is writable and begins at a page.
    """

    def __init__(self, inputs: Plain, parts: object, image: memoryview) -> None:
        self.inputs = inputs
        self.parts = parts
        self.image = image


def find() -> tuple[Kept | None, str]:
    """What is kept for this command line, directory and executable, or why it cannot be used; "" if nothing is kept."""
    return None, ""


def write(inputs: Plain, parts: object, image: bytes) -> None:
    """Keep a program for this command line, directory and executable. Raises OSError."""
