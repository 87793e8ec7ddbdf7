#!/bin/bash
# `router` in the container: sets up ROS and the comms interfaces first, also where `docker exec` calls it.
set -e
# shellcheck disable=SC1091
source /opt/rover_router/ros/setup.bash
exec /opt/rover_router/venv/bin/router "$@"
