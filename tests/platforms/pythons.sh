#!/usr/bin/env bash
# Runs `make test` with each Python from 3.10 to 3.13 found here, and prints which passed, failed or are missing.
#
#   tests/platforms/pythons.sh [VARIABLE=VALUE...]   variables for make, for example TESTS=tests/wire
#
# Tests the last commit, for each Python in a separate clone. Clones and logs are kept in $ROUTER_PYTHONS, by default
# ~/.cache/rover-router/pythons, so that the next set-up takes seconds.
set -euo pipefail
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
folder=${ROUTER_PYTHONS:-$HOME/.cache/rover-router/pythons}
. "$repository/deploy/find-python.sh"

test_with() {  # VERSION PYTHON VARIABLE=VALUE...
  local clone=$folder/python$1 python=$2
  shift 2
  { [ -d "$clone" ] || git clone --quiet --no-checkout "$repository" "$clone"; } \
    && git -C "$clone" fetch --quiet "$repository" HEAD \
    && git -C "$clone" checkout --quiet --force --detach FETCH_HEAD \
    && make -C "$clone" test PYTHON="$python" "$@"
}

mkdir -p "$folder"
results=()
status=0
for version in "${supported_pythons[@]}"; do
  if ! python=$(find_python "$version"); then
    results+=("Python $version: not found")
    continue
  fi
  log=$folder/python$version.log
  printf 'Python %s: %s, writing to %s ...\n' "$version" "$python" "$log"
  if test_with "$version" "$python" "$@" >"$log" 2>&1; then outcome=passed; else outcome=FAILED status=1; fi
  summary=$(grep -E '[0-9]+ (passed|failed|errors?)' "$log" | tail -n 1) || true
  results+=("Python $version: $outcome: ${summary:-$(tail -n 1 "$log")}")
done
printf '%s\n' "${results[@]}"
exit $status
