#!/usr/bin/env bash
# Installs the router from a wheel, as in docs/guides/deploy.md, on an emulated aarch64 with Python 3.13. Runs
# installed.sh, and the carrier's tests that need no ROS, which has no wheels for aarch64. Needs root. Takes an hour the
# first time, when it builds the root file system.
#
#   tests/platforms/arm64.sh [TEST...]     arguments for pytest; by default all tests of the carrier
#
# Tests the last commit. Says nothing about speed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

script='
set -euo pipefail
say() { printf "\n== %s (%s s)\n" "$*" $SECONDS; }
cd "$(mktemp -d)"
mkdir checkout
tar x -C checkout
python3 -m venv venv
. venv/bin/activate
say "install, on $(uname -m), $(python3 -V)"
# Compile only imported modules: compiling all takes as long as everything else.
export PIP_CONSTRAINT=$PWD/checkout/constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_COMPILE=1
pip wheel -q --no-deps -w dist ./checkout
ls dist
pip install -q "$(echo dist/*.whl)[gateways,foxglove,recording]"
du -sh venv
checkout/tests/platforms/installed.sh venv/bin/router
say "the carrier: tests"
pip install -q pytest pytest-xdist hypothesis
cd checkout
python3 -m pytest -q -n auto --dist loadfile -o faulthandler_timeout=3600 -m "not slow" "${@:-tests/carrier}"
say "done"
'
git archive HEAD | tests/platforms/root.sh trixie-arm64 bash -c "$script" arm64.sh "$@"
