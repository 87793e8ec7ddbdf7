#!/usr/bin/env bash
# Builds .venv with the router, ROS 2 Jazzy and the interfaces of schemas/comms, and the carrier's library. As colcon, it
# leaves schemas/comms out if that contains a file COLCON_IGNORE.
# `make setup` calls it.
#
#   PYTHON=...  the interpreter to use, 3.10 to 3.13; default: the first suitable one
#   ROS=...     an installed Jazzy (/opt/ros/jazzy) to use instead of the wheels; default: the sourced one, if any
#   DEV=no      leave out what only tests, lint and documentation need; DEV=yes adds it again
#
# Each step stores the checksum of its inputs in .venv/.made, and runs again when it changes. The choices above are also
# stored there. The output of all steps is in .venv/setup.log.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

root=$PWD
venv=$root/.venv
python=$venv/bin/python
made=$venv/.made
log=$venv/setup.log

die() {
  printf 'setup: %s\n' "$@" >&2
  exit 1
}

checksum() {  # of standard input
  sha256sum | cut -d' ' -f1
}

is_made() {  # STEP CHECKSUM
  [ -f "$made/$1" ] && [ "$(cat "$made/$1")" = "$2" ]
}

step() {  # STEP CHECKSUM TITLE COMMAND...: run it unless it is made; print one line, write its output to the log
  local name=$1 sum=$2 title=$3 started=$SECONDS status
  shift 3
  ! is_made "$name" "$sum" || return 0
  rm -f "$made/$name"
  printf 'setup: %s ... ' "$title"
  set +e  # not `if ! "$@"`: a condition would disable `set -e` inside the step
  (set -e; "$@") >>"$log" 2>&1
  status=$?
  set -e
  if [ $status -ne 0 ]; then
    printf 'failed\n'
    tail -n 30 "$log" >&2
    die "$title failed; the whole output is in ${log#"$root"/}"
  fi
  printf '%s s\n' $((SECONDS - started))
  printf '%s\n' "$sum" >"$made/$name"
}

find_sourced_ros() {
  local prefix prefixes
  [ "${ROS_DISTRO:-}" = jazzy ] || return 0
  IFS=: read -ra prefixes <<<"${AMENT_PREFIX_PATH:-}"
  for prefix in "${prefixes[@]}"; do
    if [ -d "$prefix/share/rclpy" ]; then
      printf '%s' "$prefix"
      return
    fi
  done
}

is_supported() {  # PYTHON
  "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

missing_for() {  # PYTHON: print the missing Debian packages that it needs to build the environment
  "$1" - <<'END'
import importlib.util, pathlib, sys, sysconfig
name = f"python{sys.version_info[0]}.{sys.version_info[1]}"
if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
    print(f"{name}-venv")
if not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists():
    print(f"{name}-dev")
END
}

find_python() {  # print the first supported interpreter that has all it needs, else the first supported one
  local candidate candidates first='' library
  # The distribution's first: it is built with profile-guided optimization and runs the router a fifth faster than an
  # interpreter compiled from source with default options.
  candidates=(/usr/bin/python3 python3 python3.13 python3.12 python3.11 python3.10)
  if [ -n "$ros" ]; then  # rclpy there works with one interpreter only
    candidates=()
    for library in "$ros"/lib/python3.*; do candidates+=("$(basename "$library")"); done
  fi
  if [ -n "${PYTHON:-}" ]; then candidates=("$PYTHON"); fi
  for candidate in "${candidates[@]}"; do
    is_supported "$candidate" || continue
    if [ -z "$(missing_for "$candidate")" ]; then
      printf '%s' "$candidate"
      return
    fi
    first=${first:-$candidate}
  done
  printf '%s' "$first"
}

check_tools() {
  local missing=()
  command -v cmake >/dev/null || missing+=(cmake)
  command -v "${CC:-cc}" >/dev/null || missing+=(gcc)
  command -v "${CXX:-c++}" >/dev/null || missing+=(g++)
  if [ -n "$base" ]; then
    mapfile -t -O "${#missing[@]}" missing < <(missing_for "$base")
  elif [ -n "${PYTHON:-}" ]; then
    die "PYTHON=$PYTHON is not a Python 3.10 to 3.13"
  else
    missing+=(python3 python3-venv python3-dev)
  fi
  if [ -n "$ros" ] && [ ! -d "$ros/share/rosidl_default_generators" ]; then
    missing+=(ros-jazzy-rosidl-default-generators)
  fi
  [ ${#missing[@]} -eq 0 ] || die "packages are missing; on Debian or Ubuntu:" "  apt-get install ${missing[*]}"
}

make_environment() {
  "$base" -m venv ${ros:+--system-site-packages} "$venv"
  printf '%s\n' "${to_source:-# Nothing to set: the wheels find their libraries themselves.}" >"$venv/env.sh"
  printf '%s' "$ros" >"$made/ros"
  printf '%s' "$dev" >"$made/dev"
}

install_packages() {
  local extras=ros,gateways,foxglove,recording constraints=$root/constraints.txt
  if [ -n "$ros" ]; then
    extras=${extras#ros,}
    # The distribution's rclpy is built for the distribution's numpy.
    constraints=$made/constraints.txt
    grep -v '^numpy==' "$root/constraints.txt" >"$constraints"
  fi
  if [ "$dev" = yes ]; then extras=$extras,dev; fi
  # Unlike pip's option, the variable also applies to the packages that pip needs to build this one.
  PIP_CONSTRAINT=$constraints PIP_DISABLE_PIP_VERSION_CHECK=1 \
    "$python" -m pip install --no-input --editable "$root[$extras]"
}

build_carrier() {
  AMENT_PREFIX_PATH=$ros "$python" router/carrier/build.py --rcl
}

remove_comms() {
  if [ -f "$made/comms.files" ]; then xargs -d '\n' rm -f <"$made/comms.files"; fi
}

build_comms() (
  build=$venv/build/comms
  rm -rf "$build"  # left by a failed build; reusing it saves no time, because the generators rewrite every file
  if [ -n "$ros" ]; then
    set +u  # ROS's script reads variables that nobody set
    # shellcheck disable=SC1091
    . "$ros/setup.bash"
    set -u
  else
    libraries=$(printf ':%s' "$venv"/lib/python3.*/site-packages/ros_*.libs)
    export AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv LD_LIBRARY_PATH=$venv/lib$libraries
  fi
  cmake -S schemas/comms -B "$build" -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX="$venv" \
    -DPython3_EXECUTABLE="$python" -DBUILD_TESTING=OFF -DCMAKE_PROJECT_comms_INCLUDE="$root/deploy/interfaces.cmake"
  cmake --build "$build" --parallel "$(nproc)"
  # Remove the old files only now, so that a failed build keeps them. This includes files of deleted messages.
  remove_comms
  cmake --install "$build"
  mv "$build/install_manifest.txt" "$made/comms.files"
  rm -r "$build"
)

# The service may not write to the checkout, so without this it would compile the bytecode at each start.
compile_router() {
  "$python" -m compileall -q router
}

is_usable() {  # whether the environment was made here and has an interpreter that works and is the requested one
  local identity='import sys; print(sys.base_prefix, sys.version)'
  is_made environment "$environment" && "$python" -c '' 2>/dev/null || return 1
  [ -z "${PYTHON:-}" ] || [ "$("$PYTHON" -c "$identity")" = "$("$python" -c "$identity")" ]
}

# One set-up at a time. The lock is on this file itself, and ends with the process.
exec 9<"${BASH_SOURCE[0]}"
flock 9

remembered=$(cat "$made/ros" 2>/dev/null || find_sourced_ros)
ros=${ROS:-$remembered}
# What must be sourced before .venv/bin/router runs: nothing with ROS from wheels. ROS's script leaves
# AMENT_CURRENT_PREFIX set, and the script of the interfaces would use it as their location.
to_source=${ros:+. \"$ros/setup.sh\"
unset AMENT_CURRENT_PREFIX
if [ -e \"$venv/share/comms/local_setup.sh\" ]; then . \"$venv/share/comms/local_setup.sh\"; fi}
dev=${DEV:-$(cat "$made/dev" 2>/dev/null || echo yes)}
[[ $dev =~ ^(yes|no)$ ]] || die "DEV=$dev is neither yes nor no"
environment=$(printf '%s\n' "$root" "$to_source" "$dev" | checksum)
packages=$(cat pyproject.toml constraints.txt | checksum)
carrier=library  # a constant: the library contains the checksum of its sources
"$python" router/carrier/build.py --check 2>/dev/null || rm -f "$made/carrier"
# The generated code also depends on the pinned packages that it is compiled against.
comms=$({ find schemas/comms deploy/interfaces.cmake -type f | sort | xargs sha256sum; grep -E '^(ros-|numpy)' constraints.txt; } | checksum)

if is_usable && is_made packages "$packages" && is_made carrier "$carrier" && is_made comms "$comms"; then
  compile_router
  echo "setup: .venv is up to date"
  exit
fi
if ! is_usable; then
  base=$(find_python)
  check_tools
  rm -rf "$venv"
  mkdir -p "$made"
  step environment "$environment" "environment with $("$base" --version)" make_environment
fi
step packages "$packages" "packages${ros:+, with ROS from $ros}" install_packages
step carrier "$carrier" "carrier" build_carrier
if [ -e schemas/comms/COLCON_IGNORE ]; then
  step comms "$comms" "no ROS interfaces of schemas/comms" remove_comms
else
  step comms "$comms" "ROS interfaces of schemas/comms" build_comms
fi
compile_router
