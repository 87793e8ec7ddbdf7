#!/usr/bin/env bash
# Follows docs/guides for ROS 2 from apt, on Ubuntu 24.04 with a /opt/ros/jazzy built by ros_prefix.py. Needs root.
#
#   tests/platforms/apt.sh [STEP...]     by default all, in this order
#
#   setup      make setup ROS=/opt/ros/jazzy, router validate, doctor and test, as docs/guides/deploy.md says
#   demo       make demo
#   service    the tests of tests/deploy/test_systemd.py: make install-service, under a real systemd
#   workspace  colcon build and the built router, as docs/guides/ros-workspace.md says, and test_ros_package.py
#   test       make test; TESTS=tests/ros for some
#
# Tests the last commit in the clone ~rover/ws/src/router of the root file system `noble` (root.sh), and keeps the
# clone. The user rover runs everything except the service. `ros2 run` and `ros2 launch` are not tested, because PyPI has
# neither ros2cli nor launch.
set -euo pipefail
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
here=$repository/tests/platforms
clone=/home/rover/ws/src/router
# Dependencies of ros-jazzy-ros-base from Ubuntu, then those of the steps.
packages="python3-catkin-pkg python3-empy python3-lark python3-numpy python3-packaging python3-psutil"
packages+=" python3-setuptools python3-yaml systemd systemd-sysv"
steps=("$@")
[ $# -gt 0 ] || steps=(setup demo service workspace test)

prepare() {
  NEEDS=$packages "$here/root.sh" noble bash -ec '
    if [ ! -e /opt/ros/jazzy/setup.sh ]; then
      rm -rf /opt/ros/jazzy
      python3 /checkout/tests/platforms/ros_prefix.py /opt/ros/jazzy
    fi
    id rover >/dev/null 2>&1 || useradd --create-home --shell /bin/bash rover'
  git -C "$repository" bundle create --quiet - HEAD | as_rover "
    cat >/tmp/bundle
    [ -d $clone ] || git clone --quiet --no-checkout /tmp/bundle $clone
    git -C $clone fetch --quiet /tmp/bundle HEAD
    git -C $clone checkout --quiet --force --detach FETCH_HEAD"
}

as_rover() {  # COMMANDS
  "$here/root.sh" noble setpriv --reuid rover --regid rover --init-groups \
    env HOME=/home/rover USER=rover TESTS="${TESTS:-}" bash -ec "$1"
}

setup() {
  as_rover "
    cd $clone
    make setup ROS=/opt/ros/jazzy
    . .venv/env.sh
    export PATH=\$PWD/.venv/bin:\$PATH
    router validate routes/
    router test routes/
    router doctor -t routes/sim.yaml"
}

demo() {
  as_rover "cd $clone && make demo"
}

service() {
  "$here/root.sh" noble bash -ec "
    cd $clone
    . .venv/env.sh
    # The clone belongs to rover and contains no files of root.
    PYTHONDONTWRITEBYTECODE=1 .venv/bin/python -m pytest -q -p no:cacheprovider tests/deploy/test_systemd.py"
}

workspace() {
  as_rover "
    [ -d ~/colcon ] || python3 -m venv ~/colcon
    ~/colcon/bin/pip install --quiet colcon-common-extensions
    cd $clone
    make setup
    . .venv/env.sh
    cd ~/ws
    rm -rf build install log
    ~/colcon/bin/colcon build
    . install/setup.sh
    program=install/rover_router/lib/rover_router/router
    \$program validate install/rover_router/share/rover_router/routes
    \$program doctor -t install/rover_router/share/rover_router/routes/sim.yaml
    cd $clone
    .venv/bin/python -m pytest -q tests/deploy/test_ros_package.py"
}

test() {
  as_rover "cd $clone && make test"
}

prepare
for step in "${steps[@]}"; do
  printf 'apt.sh: %s\n' "$step"
  "$step"
done
