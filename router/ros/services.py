"""Services and clients of the node, whose requests and responses are CDR bytes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import count, islice
from time import monotonic, sleep
from typing import Any, NamedTuple

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from router.compiler.compiled_table import CalledPlan, ClientCallPlan, ServicePlan
from router.log import logger
from router.ros.node import RCL_ERRORS, start_error
from router.ros.rcl import callback_setter
from router.ros.receiving import announce, sent_at
from router.ros.types import service_class

MOST_WAITING = 1000
"""Requests that wait to be taken, and responses that wait for their clients, of all clients together. ROS keeps 10 by
default, and loses the others without a word.
"""

LINGER_S = 0.2
"""How long a service stays open after a response, in seconds: a client that has not taken it by then may lose it."""
_LOOK_S = 0.01
"""How often it looks for calls meanwhile, in seconds."""

_set_callback = callback_setter("rcl_service_set_on_new_request_callback")
_set_callback_of_client = callback_setter("rcl_client_set_on_new_response_callback")


class Request(NamedTuple):
    """A request that a client sent at `called_at` (wall clock, ns). `header` identifies it for the response."""

    message: bytes
    header: Any
    called_at: int


class Response(NamedTuple):
    """A response to the request with this number."""

    number: int
    message: bytes


class ServedService:
    """A service of the node. Requests add to an eventfd. For one thread."""

    def __init__(self, node: Node, plan: ServicePlan, eventfd: int) -> None:
        """Open the service. Raises StartError if its type is not installed, or the middleware refuses it."""
        self.plan = plan
        self._node = node
        self._type = service_class(plan.type_name, plan.definitions, plan.span)
        self.answered_at = -LINGER_S
        try:
            self._service = node.create_service(
                self._type,
                plan.name,
                lambda _, response: response,  # not called without an executor
                qos_profile=QoSProfile(depth=MOST_WAITING),
                callback_group=ReentrantCallbackGroup(),  # the node's own group would leak memory
            )
            announce(_set_callback, self._service.handle, eventfd, "requests")
        except RCL_ERRORS as error:
            raise start_error(error, f"{plan.span}: service '{plan.name}' cannot be opened: {error}") from error

    def take(self) -> Request | None:
        """Return the oldest request; None if there is none. Raises one of RCL_ERRORS."""
        handle = self._service.handle
        with handle:
            request, header = handle.service_take_request(self._type.Request)
        if request is None:
            return None
        return Request(serialize_message(request), header, sent_at(header.source_timestamp, header.received_timestamp))

    def waiting(self) -> Iterator[Request]:
        """Take the requests that wait, not those that clients go on to send. Raises one of RCL_ERRORS."""
        return islice(iter(self.take, None), MOST_WAITING)

    def answer(self, request: Request, response: bytes) -> None:
        """Send a response. Raises one of RCL_ERRORS."""
        self._service.send_response(deserialize_message(response, self._type.Response), request.header)
        self.answered_at = monotonic()

    def cancel_waiting(self) -> None:
        """Answer the requests that wait as cancelled."""
        cancelled = 0
        try:
            for request in self.waiting():
                self.answer(request, self.plan.responses["cancelled"])
                cancelled += 1
        except RuntimeError as error:  # of rcl
            logger.warning("calls that waited are lost", service=self.plan.name, problem=str(error))
        if cancelled:
            logger.info("calls were cancelled, because their service closes", service=self.plan.name, calls=cancelled)

    def close(self) -> None:
        """Close it at once: see `close_services`."""
        _set_callback(self._service.handle.pointer, None, None)
        self._node.destroy_service(self._service)


def close_services(services: Collection[ServedService]) -> None:
    """Close services, after clients have had time to take the last response. Calls until then are cancelled."""
    for each in services:
        each.cancel_waiting()
    until = max((each.answered_at for each in services), default=0.0) + LINGER_S
    while monotonic() < until:
        sleep(_LOOK_S)
        for each in services:
            each.cancel_waiting()
    for each in services:
        each.close()


class CallingClient:
    """A client of the node. Responses add to an eventfd. For one thread."""

    def __init__(self, node: Node, plan: CalledPlan | ClientCallPlan, eventfd: int) -> None:
        """Open the client. Raises StartError if its type is not installed, or the middleware refuses it."""
        self.plan = plan
        self._node = node
        self._type = service_class(plan.type_name, plan.definitions, plan.span)
        try:
            self._client = node.create_client(
                self._type,
                plan.service,
                qos_profile=QoSProfile(depth=MOST_WAITING),
                callback_group=ReentrantCallbackGroup(),
            )
            announce(_set_callback_of_client, self._client.handle, eventfd, "responses")
        except RCL_ERRORS as error:
            raise start_error(error, f"{plan.span}: service '{plan.service}' cannot be called: {error}") from error

    def ask(self, request: bytes) -> int | None:
        """Send a request, and return its number; None without a server. Raises one of RCL_ERRORS."""
        if not self._client.service_is_ready():
            return None
        handle = self._client.handle
        with handle:
            number: int = handle.send_request(deserialize_message(request, self._type.Request))
        return number

    def take_all(self, arrived: int) -> Iterator[Response]:
        """Take the responses that have arrived. `arrived` is what the eventfd has had added since the last call.

        The middleware gives each client the responses to all clients of the service. A take that removes another
        client's returns nothing, although more may wait, so at least `arrived` takes are made. Raises one of
        RCL_ERRORS.
        """
        for takes in count(1):
            if (response := self._take()) is not None:
                yield response
            elif takes >= arrived:
                return

    def _take(self) -> Response | None:
        handle = self._client.handle
        with handle:
            header, response = handle.take_response(self._type.Response)
        return None if header is None else Response(header.request_id.sequence_number, serialize_message(response))

    def close(self) -> None:
        _set_callback_of_client(self._client.handle.pointer, None, None)
        self._node.destroy_client(self._client)
