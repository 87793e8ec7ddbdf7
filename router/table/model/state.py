"""States: named values that messages set and conditions read."""

from dataclasses import dataclass
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.keys import Listed, Named, Shape
from router.table.model.expressions import Expression
from router.table.model.targets import Topic
from router.table.units import VALIDITY


@dataclass(frozen=True, slots=True)
class State:
    """A value that messages of a payload case, or of a ROS topic, set, and that conditions read as 'state.NAME'.

    `span` is its name in the table. It has either `case` and `sources` or a `topic`. `valid_for` is in ns, 0 for never,
    None if it is not set.

    Example: {case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL, valid_for: 5s}
    Example: {topic: emergency_stop, type: std_msgs/msg/Bool, value: data, initial: true, valid_for: 1s}
    """

    name: str
    span: SourceSpan
    value: Expression
    """An expression over the message that gives an integer, a bool, an enum or a text of at most 32 bytes. A message
    for which it has no value, a number that the enum does not name, or a longer text leaves the state unchanged and is
    counted as dropped.

    Example: mode
    """
    initial: Annotated[Expression, Shape("constant")]
    """The value until a message sets it, and again when none has for 'valid_for': a constant, for an enum the name of a
    value, for a text the text in quotes of its own. Write the one that stops the rover.

    Example: MODE_MANUAL
    Example: "'MANUAL'"
    """
    case: Located[str] | None = None
    """The payload case whose messages set it. A route takes them, or the state never changes.

    Title: Payload case
    Example: control_mode
    """
    sources: Annotated[tuple[Located[str], ...], Named("source"), Listed(least=1, unique=True, alone=True)] = ()
    """The endpoint or endpoints whose messages set it.

    Example: basestation
    """
    topic: Topic | None = None
    valid_for: Annotated[Located[int] | None, VALIDITY] = None
    """How long a message counts, from its arrival, or for a topic from its publication or stamp; the state is then
    'initial' again. Required if the condition of a command reads the state. never: until another message comes.

    Example: 5s
    Example: never
    """
    because: Annotated[str | None, Shape("reason")] = None
    """Why commands may depend on a value of any age. Required with 'valid_for: never' if they do.

    Example: the basestation sends the mode only when it changes
    Error: must say why
    """
