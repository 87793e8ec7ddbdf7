#!/usr/bin/env bash
# Builds a release into dist/: the sdist of the last commit, and the wheel from this sdist. `make dist` calls it.
#
# One wheel fits every supported Python on this platform. For each Python found here, the script installs the wheel into
# a new environment and runs tests/platforms/installed.sh there, both without network if the system allows it. It fills
# dist/ only after all checks have passed. Logs, and the environment of a failed check, are in build/dist.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. deploy/find-python.sh

root=$PWD
work=$root/build/dist
export PIP_CONSTRAINT=$root/constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1

die() {
  printf 'dist: %s\n' "$@" >&2
  exit 1
}

find_isolation() {  # print the command that disconnects the network; nothing if the system does not allow it
  local command
  for command in "unshare --net" "unshare --map-root-user --net"; do
    # shellcheck disable=SC2086
    if $command ip link set lo up 2>/dev/null; then
      printf '%s' "$command"
      return
    fi
  done
}

check_wheel() {  # PYTHON FOLDER: install the wheel into a new environment and try it
  local extras=gateways,foxglove,recording
  # ROS has wheels for x86_64 only.
  if [ "$(uname -m)" = x86_64 ]; then extras+=,ros; fi
  local requirement="$wheel[$extras]"
  mkdir -p "$2/home"
  "$1" -m venv "$2/venv"
  # With PEP 517, because pip of Python 3.10 and 3.11 cannot build empy with its setup.py unless `wheel` is installed.
  "$2/venv/bin/pip" wheel --use-pep517 --wheel-dir "$2/packages" "$requirement"
  # Keep nothing from this shell, such as a sourced ROS.
  # shellcheck disable=SC2016,SC2086
  env --ignore-environment --chdir "$2/home" HOME="$2/home" PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin \
    $isolation bash -euo pipefail -c '
      [ -z "$4" ] || ip link set lo up
      "$1/venv/bin/pip" install --disable-pip-version-check --no-index --find-links "$1/packages" "$2"
      "$1/venv/bin/pip" check
      [ "$("$1/venv/bin/router" --version)" = "router $3" ]
      "$5/tests/platforms/installed.sh" "$1/venv/bin/router"' \
    bash "$2" "$requirement" "$version" "$isolation" "$root"
}

changed=$(git status --porcelain)
[ -z "$changed" ] || die "commit these changes first, because a release is built from a commit:" "$changed"
version=$(.venv/bin/python -c 'import router; print(router.__version__)')
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)  # the same commit gives the same bytes
export SOURCE_DATE_EPOCH
isolation=$(find_isolation)
[ -n "$isolation" ] || echo "dist: this system does not allow network namespaces: checking with network"

rm -rf "$work"
mkdir -p "$work"
sdist=$work/rover_router-$version.tar.gz
.venv/bin/python -m hatchling build --target sdist --directory "$work" >/dev/null
.venv/bin/python -m pip wheel --quiet --no-deps --wheel-dir "$work" "$sdist"
wheel=$(echo "$work"/*.whl)
[[ $wheel == *-py3-none-linux_* ]] || die "the wheel has no carrier: see 'python router/carrier/build.py'"

checked=0
for minor in "${supported_pythons[@]}"; do
  if ! python=$(find_python "$minor"); then
    echo "Python $minor: not found"
    continue
  fi
  set +e  # not `if ! (...)`: a condition would disable `set -e` inside the function
  (set -e; check_wheel "$python" "$work/$minor") >"$work/$minor.log" 2>&1
  status=$?
  set -e
  if [ $status -ne 0 ]; then
    tail -n 30 "$work/$minor.log" >&2
    die "Python $minor: failed; the whole output is in build/dist/$minor.log"
  fi
  echo "$("$python" --version): passed"
  rm -r "${work:?}/$minor"  # 600 MB
  checked=$((checked + 1))
done
[ $checked -gt 0 ] || die "no Python from ${supported_pythons[0]} to ${supported_pythons[-1]} was found"

rm -rf dist
mkdir dist
mv "$sdist" "$wheel" dist/
(cd dist && sha256sum ./*)
