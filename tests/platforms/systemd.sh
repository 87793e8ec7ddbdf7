#!/usr/bin/env bash
# Runs tests/deploy/test_systemd.py on a booted root file system of root.sh: with systemd as process 1, udev, and the
# right to raise limits, as on a rover. Needs root, and takes some minutes.
#
#   tests/platforms/systemd.sh noble|trixie [PYTEST ARGUMENT...]
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
roots=${ROUTER_ROOTS:-$HOME/.cache/rover-router/roots}
name=${1:?noble or trixie}
shift
"$here/root.sh" "$name" true

# A copy of this checkout in the root file system. Its environment is kept for the next run.
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
