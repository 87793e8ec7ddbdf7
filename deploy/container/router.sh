#!/bin/bash
# `router` in the container: sources ROS and the comms interfaces first, so that it also works with `docker exec`.
set -e
# shellcheck disable=SC1091
source /opt/rover_router/ros/setup.bash
exec /opt/rover_router/venv/bin/router "$@"
