"""Opens a ROS node in a context of its own, with the transports that the environment selects."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rclpy.context import Context
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_rmw_implementation_identifier

from router.errors import ConfigurationError, StartError
from router.lazy_import import lazy_import
from router.log import logger
from router.ros.environment import unresolved_peers

RCL_ERRORS = (RuntimeError, NameValidationException, ParameterException)
"""The errors of rclpy for invalid arguments, names and settings; its own errors derive from RuntimeError."""

UDP_ON_LOCALHOST = Path(__file__).with_name("fastdds_udp_localhost.xml")
"""A profile of Fast DDS: UDP as its only transport, discovery on this computer only."""

_SIM_TIME = "use_sim_time"
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


def open_node(name: str, namespace: str = "/", ros_args: Sequence[str] = ()) -> Node:
    """Open a node without signal handlers or rclpy's global context, for `close_node` to close. Raises StartError."""
    context = Context()
    try:
        with _environment(_transport_variables(os.environ)):
            # The router has its own log, so it needs no log file of ROS and no /rosout. It has no parameter services:
            # parameters set the table's variables at start, and setting them later would have no effect. It has no
            # type description service: rclpy's executor would answer it, and none runs.
            context.init(list(ros_args), initialize_logging=False)
            with lazy_import("numpy"):  # for fields of fixed length, which CDR bytes do not need
                node = Node(
                    name,
                    namespace=namespace,
                    context=context,
                    enable_rosout=False,
                    start_parameter_services=False,
                    parameter_overrides=[Parameter("start_type_description_service", value=False)],
                )
        _ignore_sim_time(node)
        return node
    except RCL_ERRORS as error:
        context.try_shutdown()
        for unresolved in unresolved_peers(os.environ):
            raise unresolved from error
        raise start_error(error, f"the ROS node cannot be created: {error}") from error


def start_error(error: Exception, what: str) -> StartError:
    """Return the error for one of RCL_ERRORS. A RuntimeError may mean that something has run out."""
    return (StartError if isinstance(error, RuntimeError) else ConfigurationError)(what)


def check_arguments(ros_args: Sequence[str]) -> None:
    """Raise ConfigurationError for arguments that ROS rejects, StartError if it also fails without arguments.

    Opens no node.
    """
    try:
        _try_context(ros_args)
    except RCL_ERRORS as error:
        try:
            _try_context(())
        except RCL_ERRORS as cause:
            raise StartError(f"ROS cannot be started: {cause}") from cause
        raise ConfigurationError(f"ROS rejects these arguments: {error}") from error


def _try_context(ros_args: Sequence[str]) -> None:
    context = Context()
    context.init(list(ros_args), initialize_logging=False)
    context.try_shutdown()


def _ignore_sim_time(node: Node) -> None:
    """Warn of `use_sim_time`, and drop the subscription to /clock that comes with it."""
    if node.get_parameter(_SIM_TIME).value:
        logger.warning(
            f"{_SIM_TIME} is ignored: the router uses real time (stamps, ttl, deadman timers)",
            remedy=f"leave {_SIM_TIME} out for this node, or set it to false (docs/guides/ros-workspace.md)",
        )
        node.set_parameters([Parameter(_SIM_TIME, value=False)])


def close_node(node: Node) -> None:
    node.destroy_node()
    node.context.try_shutdown()


def _transport_variables(variables: Mapping[str, str]) -> dict[str, str]:
    """Return variables that make FASTDDS_BUILTIN_TRANSPORTS=UDPv4 effective with a discovery range of LOCALHOST.

    With that range, rmw_fastrtps opens shared memory and UDP, whatever the variable says. Our profile has the other
    effects of the range, and the range SUBNET does not change the profile.
    """
    wanted = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOCALHOST_ONLY": "1"}
    is_local = any(variables.get(name) == value for name, value in wanted.items())
    if not is_local or variables.get("FASTDDS_BUILTIN_TRANSPORTS") != "UDPv4":
        return {}
    if taken := next((name for name in _PROFILES if variables.get(name)), None):
        logger.warning(
            f"{taken} is set: with a discovery range of LOCALHOST, Fast DDS uses shared memory even though "
            "FASTDDS_BUILTIN_TRANSPORTS is UDPv4",
            remedy=f"unset {taken}, or set it to {UDP_ON_LOCALHOST} and set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET",
        )
        return {}
    chosen = {_PROFILES[0]: str(UDP_ON_LOCALHOST), "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    if "ROS_LOCALHOST_ONLY" in variables:  # rcl warns whenever it is set
        chosen["ROS_LOCALHOST_ONLY"] = "0"
    return chosen


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables, which the middleware reads, within the context."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def middleware() -> str:
    """Return the name of the middleware, for example `rmw_fastrtps_cpp`. Raises StartError if it cannot be loaded."""
    try:
        name: str = get_rmw_implementation_identifier()
    except RuntimeError as error:
        raise StartError(f"the middleware of ROS cannot be loaded: {error}") from error
    return name
