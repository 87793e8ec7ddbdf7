#!/usr/bin/env bash
# Runs tests/deploy/test_systemd.py on a booted computer: with the systemd of a root of root.sh as process 1, udev, and
# the right to raise limits, which is what a rover has. Needs root, and some minutes.
#
#   tests/platforms/systemd.sh noble|trixie [PYTEST ARGUMENT...]
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
roots=${ROUTER_ROOTS:-$HOME/.cache/rover-router/roots}
name=${1:?noble or trixie}
shift
"$here/root.sh" "$name" true

# A copy of this checkout in the root, with an environment that stays for the next time.
copy=$roots/$name/srv/router
mkdir -p "$copy"
find "$copy" -mindepth 1 -maxdepth 1 ! -name .venv -exec rm -rf {} +
git -C "$here/../.." ls-files -z | tar -C "$here/../.." --null -T - -c | tar -C "$copy" -x
"$here/root.sh" "$name" make -C /srv/router setup
"$here/boot.sh" "$name" bash -c '
  cd /srv/router
  systemctl --version | head -n 1
  systemd-analyze security --offline=true --no-pager deploy/systemd/rover-router.service | tail -n 1
  .venv/bin/python -m pytest -p no:cacheprovider -rs tests/deploy/test_systemd.py "$@"' systemd "$@"
