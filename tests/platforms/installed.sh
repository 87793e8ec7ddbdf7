#!/usr/bin/env bash
# Tests an installed router in the current folder: its tables, a router from UDP to UDP, and, if ROS is installed, a
# router that publishes to a ROS topic.
#
#   tests/platforms/installed.sh VENV/bin/router
set -euo pipefail
here=$(dirname "$(realpath "${BASH_SOURCE[0]}")")
router=$(realpath --no-symlinks "$1")
python=$(dirname "$router")/python
say() { printf '\n== %s (%s s)\n' "$*" $SECONDS; }

say "init, validate, test"
"$router" init --rover rover
(cd rover && "$router" validate routes/ && "$router" test routes/)

say "a router from UDP to UDP"
"$python" "$here/udp_to_udp.py" "$router"

if "$python" -c 'import rclpy' 2>/dev/null; then
  say "a router from UDP to ROS"
  "$router" init first
  cd first
  "$router" run &
  started=($!)
  "$router" sim >/dev/null &
  started+=($!)
  trap 'kill "${started[@]}" && wait' EXIT
  "$router" listen topic://battery --count 3 --for 60s --json | tee ../heard
  [ "$(wc -l <../heard)" = 3 ]
fi
