"""Services: ROS services that boards answer, and ROS services that boards call."""

from dataclasses import dataclass
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.keys import Named, Range, Shape, Words
from router.table.model.expressions import Expression, FieldMap
from router.table.units import DURATION


@dataclass(frozen=True, slots=True)
class ServiceRequest:
    """What a call sends: a payload `case`, `to` an endpoint, filled with the fields of the service's request.

    `span` is the key `request`. `ttl` is in ns; `no_ttl` is the reason why requests of any age may leave.
    """

    span: SourceSpan
    case: Located[str]
    """The payload case that is sent for each call.

    Title: Payload case
    Example: arm_request
    """
    to: Located[str]
    """The endpoint that gets it.

    Example: arm_board
    """
    fields: FieldMap | None = None
    ttl: Annotated[Located[int] | None, DURATION, Shape("age_limit"), Words("dropped when older than {}")] = None
    """The greatest age of a call when its request is first sent, from when the client called; an older one is answered
    with 'on_timeout' instead. {none: why} says that any age is intended.

    Title: Time to live
    Example: 200ms
    """
    no_ttl: Annotated[str | None, Words("no ttl: {}")] = None


@dataclass(frozen=True, slots=True)
class ServiceReply:
    """Which message answers a call: a payload `case` from an endpoint, which fills the service's response.

    `span` is the key `reply`. Without `sender`, the endpoint of the request answers.
    """

    span: SourceSpan
    case: Located[str]
    """The payload case that answers.

    Title: Payload case
    Example: arm_reply
    """
    sender: Annotated[Located[str] | None, Named("from")] = None
    """The endpoint that answers. Default: the one that gets the request."""
    match: Annotated[Expression | None, Shape("part_expression")] = None
    """A field of the envelope or of the payload, an integer, that the reply has with the same value as the request: so
    several calls can be open. Without it there is one call at a time, and any reply ends it.

    Example: envelope.req_id
    """
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class Service:
    """A ROS service that a board answers: each call becomes a message to the board, and its reply the response.

    `span` is its name in the table, which is that of the service in ROS. `timeout` is in ns.
    """

    name: str
    span: SourceSpan
    type: Located[str]
    """The ROS service type.

    Example: std_srvs/srv/SetBool
    """
    request: ServiceRequest
    reply: ServiceReply
    timeout: Annotated[Located[int], DURATION]
    """How long to wait for the reply after each time that the request is sent.

    Example: 500ms
    """
    on_timeout: Annotated[FieldMap, Shape("constants")]
    """The response, of constants, to a call that the board does not answer: it does not reply in time, cannot be sent
    to, is busy with another call, or the router reloads its table or stops. 'reason' is a text that says which.

    Example: {success: false, message: reason}
    """
    retries: Annotated[int, Range(0, 100)] = 0
    """How often the request is sent again, the same bytes each time, when no reply has come within 'timeout'."""
    because: Annotated[str | None, Shape("reason")] = None
    """Why calls may command a board that a deadman stops.

    Example: the arm does not move, it only changes its mode
    Error: must say why
    """


@dataclass(frozen=True, slots=True)
class ServiceSource:
    """Which message calls a ROS service: a payload `case` from an endpoint.

    `span` is the key `from`.
    """

    span: SourceSpan
    case: Located[str]
    """The payload case that calls the service.

    Title: Payload case
    Example: home_request
    """
    source: Located[str]
    """The endpoint that sends it, and gets the reply.

    Example: nav_board
    """


@dataclass(frozen=True, slots=True)
class ServiceCall:
    """Which ROS service is called, and how its request is filled. `span` is the key `call`, `timeout` is in ns."""

    span: SourceSpan
    service: Annotated[Located[str], Shape("service_name")]
    """The name of the service in ROS, which is resolved in the node's namespace.

    Example: get_home
    """
    type: Located[str]
    """The ROS service type.

    Example: std_srvs/srv/Trigger
    """
    timeout: Annotated[Located[int], DURATION]
    """How long to wait for the server's response.

    Example: 1s
    """
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class CalledReply:
    """What the endpoint gets: a payload `case`, filled with the fields of the service's response.

    `request.NAME` is a field of the message that called: a number, a bool or an enum. `span` is the key `reply`.
    """

    span: SourceSpan
    case: Located[str]
    """The payload case of the reply.

    Title: Payload case
    Example: home_reply
    """
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class CalledService:
    """A ROS service that an endpoint calls: its message becomes the request, and the response a message to it.

    `span` is its name in the table.
    """

    name: str
    span: SourceSpan
    source: Annotated[ServiceSource, Named("from")]
    call: ServiceCall
    reply: CalledReply
    on_timeout: FieldMap
    """The payload of the reply if there is no response: no server is there, or it does not respond in time, or the
    router reloads its table or stops. 'request.NAME' is as in 'reply', and 'reason' a text that says which.

    Example: {id: request.id, found: false}
    """
