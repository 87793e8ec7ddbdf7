"""What is open on the node for one plan: a publisher, or a subscription. Knows no thread that serves it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from time import sleep

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from router.compiler.program import TopicPlan
from router.errors import SourceSpan, StartError
from router.ros.arrivals import RawSubscription
from router.ros.node import RCL, RCL_ERRORS
from router.ros.qos import PeerEvents, publisher_qos, qos_profile, subscription_qos

_MEET_S, _LOOK_S, _OTHERS_S = 0.5, 0.005, 0.1


class _SerializedMessage(ctypes.Structure):
    """rcutils_uint8_array_t. The allocator stays zero: publishing only reads the bytes."""

    _fields_ = (
        ("buffer", ctypes.c_char_p),
        ("buffer_length", ctypes.c_size_t),
        ("buffer_capacity", ctypes.c_size_t),
        ("allocator", ctypes.c_void_p * 5),
    )


class _ErrorString(ctypes.Structure):
    """rcutils_error_string_t."""

    _fields_ = (("text", ctypes.c_char * 1024),)


# rclpy publishes with the interpreter lock held, and Fast DDS may wait for seconds in there, for a reader that has gone
# or a shared-memory port. Through ctypes the lock is released meanwhile.
_publish_serialized = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(_SerializedMessage), ctypes.c_void_p
)(("rcl_publish_serialized_message", RCL))
_error_string = ctypes.CFUNCTYPE(_ErrorString)(("rcutils_get_error_string", RCL))


def _rcl_error() -> Exception:
    """What rcl says of the last call of this thread that failed."""
    text = _error_string().text.decode(errors="replace")
    RCL.rcutils_reset_error()
    error: Exception = rclpy_implementation.RCLError(text)
    return error


class Publication:
    """A publisher. `wanted` is one boolean: whether anybody listens, or may later.

    `publish` takes CDR bytes, from any thread, with the interpreter lock released while the middleware works.
    It raises RCLError where the middleware refuses, or the publisher is closed.
    """

    def __init__(self, node: Node, peers: PeerEvents, plan: TopicPlan, message: type, span: SourceSpan) -> None:
        """Raises StartError."""
        self.plan = plan
        self.wanted = [plan.qos.serves_late_joiners]
        with _refusing(f"{span}: topic '{plan.label}' cannot be published"), ExitStack() as opening:
            self._publisher = node.create_publisher(
                message,
                plan.topic,
                qos_profile(plan.qos),
                event_callbacks=peers.of_publisher(plan, self.wanted),
                callback_group=ReentrantCallbackGroup(),  # the node's own keeps a little of each publisher for ever
            )
            opening.callback(node.destroy_publisher, self._publisher)
            handle = self._publisher.handle
            opening.enter_context(handle)
            self._open = opening.pop_all()
        self._calls: list[None] = []  # of `publish`, that have not returned
        self._is_closed = False
        self.publish = self._publish_to(handle.pointer)
        self.topic: str = handle.get_topic_name()
        self.qos = publisher_qos(handle.pointer)
        self.events: Sequence[EventHandler] = self._publisher.event_handlers

    def meet(self) -> None:
        """Waits a moment for those who listened to an earlier publisher of the topic: they find this one by and by."""
        for _ in range(int(_MEET_S / _LOOK_S)):
            if self._publisher.get_subscription_count():
                self.wanted[0] = True
                return
            sleep(_LOOK_S)

    def _publish_to(self, publisher: int) -> Callable[[bytes], None]:
        begin, end = self._calls.append, self._calls.pop

        def publish(cdr: bytes) -> None:
            begin(None)
            try:
                if self._is_closed:
                    raise rclpy_implementation.RCLError("the publisher was closed by a reload")
                size = len(cdr)
                if _publish_serialized(publisher, _SerializedMessage(cdr, size, size), None):
                    raise _rcl_error()
            finally:
                end()

        return publish

    def close(self) -> None:
        """Waits for calls of `publish` that have begun. Nobody may wait for its events any more."""
        self._is_closed = True
        while self._calls:
            sleep(_LOOK_S)
        self._open.close()


class Subscription:
    """A subscription. Nothing is taken from it before somebody does."""

    def __init__(self, node: Node, peers: PeerEvents, plan: TopicPlan, message: type, span: SourceSpan) -> None:
        """Raises StartError."""
        self.plan = plan
        with _refusing(f"{span}: topic '{plan.label}' cannot be subscribed to"):
            self.raw = RawSubscription(node, message, plan.topic, qos_profile(plan.qos), peers.of_subscription(plan))
        self.events: Sequence[EventHandler] = self.raw.events
        self.topic: str = self.raw.handle.get_topic_name()
        self.qos = subscription_qos(self.raw.handle.pointer)

    def meet(self) -> None:
        """Waits a moment for the publishers, who find this one by and by; an earlier subscription hears them meanwhile.

        They are there when the first of them is heard, or soon after that; who says nothing has time enough.
        """
        for _ in range(int(_MEET_S / _LOOK_S)):
            sleep(_LOOK_S)
            if self.raw.take():
                sleep(_OTHERS_S)
                return

    def close(self) -> None:
        """Nobody may take from it any more, and nobody waits for its events."""
        self.raw.close()


@contextmanager
def _refusing(problem: str) -> Iterator[None]:
    try:
        yield
    except RCL_ERRORS as error:
        raise StartError(f"{problem}: {error}") from error
