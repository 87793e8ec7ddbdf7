#!/bin/bash
# Sets up ROS and the comms interfaces, then becomes the command.
set -e
# shellcheck disable=SC1091
source /opt/rover_router/ros/setup.bash
exec "$@"
