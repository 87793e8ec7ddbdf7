#!/usr/bin/env bash
# Installs the router on an emulated aarch64 with Python 3.13, from a wheel as docs/guides/deploy.md says, and tries it:
# `validate` and `test`, a router from UDP to UDP with a deadman, and the carrier's tests that need no ROS, which has no
# wheels for aarch64. Needs root, and takes an hour with the root that it builds the first time.
#
#   tests/platforms/arm64.sh [TEST...]     of the carrier's, as pytest takes them; all unless said
#
# What is tested is the last commit. Do not judge speed by it.
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
# Byte code is made of what is imported only: of everything, it takes as long as all the rest.
export PIP_CONSTRAINT=$PWD/checkout/constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_COMPILE=1
pip wheel -q --no-deps -w dist ./checkout
ls dist
pip install -q dist/*.whl
du -sh venv
checkout/tests/platforms/installed.sh venv/bin/router
say "the carrier: tests"
pip install -q pytest pytest-xdist hypothesis
cd checkout
python3 -m pytest -q -n auto --dist loadfile -o faulthandler_timeout=3600 -m "not slow" "${@:-tests/carrier}"
say "done"
'
git archive HEAD | tests/platforms/root.sh trixie-arm64 bash -c "$script" arm64.sh "$@"
