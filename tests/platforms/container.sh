#!/usr/bin/env bash
# Builds deploy/container with podman, runs it with compose.yaml, and checks it. Needs root.
#
#   tests/platforms/container.sh
#
# Uses no image registry. Ubuntu 24.04 of root.sh, with ROS from ros_prefix.py, replaces ros:jazzy-ros-base; Prometheus
# and Grafana are left out. The router runs the tests' rover alone in a separate network, in which this computer has all
# addresses of rover and boards.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
checkout=$(cd "$here/../.." && pwd)
roots=${ROUTER_ROOTS:-$HOME/.cache/rover-router/roots}
container=rover_router_1
export PATH=$checkout/.venv/bin:$PATH BUILDAH_FORMAT=docker  # the other format has no health check

die() {
  printf 'container.sh: %s\n' "$@" >&2
  exit 1
}

make_base() {
  local folder
  [ -d "$roots/noble" ] || "$here/root.sh" noble true
  tar -C "$roots/noble" --one-file-system --exclude={./srv,./root,./tmp,./home,./opt,./var/cache/apt,./var/lib/apt/lists}'/*' \
    -c . | podman import --quiet - rover-test/noble >/dev/null
  folder=$(mktemp -d)
  cp "$checkout/pyproject.toml" "$checkout/constraints.txt" "$folder"
  mkdir -p "$folder/tests/platforms"
  cp "$here/ros_prefix.py" "$folder/tests/platforms"
  cat >"$folder/Dockerfile" <<'END'
FROM rover-test/noble
RUN printf '[global]\ncert = /etc/ssl/certs/ca-certificates.crt\n' >/etc/pip.conf && apt-get update -qq \
    && apt-get install -qq -y --no-install-recommends python3-catkin-pkg python3-empy python3-lark python3-numpy \
       python3-packaging python3-pip python3-psutil python3-setuptools python3-venv python3-yaml >/dev/null \
    && pip install -q --no-cache-dir --break-system-packages colcon-common-extensions
COPY . /src
RUN python3 /src/tests/platforms/ros_prefix.py && rm -rf /src
END
  build -t ros:jazzy-ros-base "$folder"
  rm -r "$folder"
}

build() {
  podman build --network host --ulimit "nofile=$(ulimit -Hn)" --ulimit nproc=4096 "$@"
}

# In a separate mount namespace, because podman does not support hybrid cgroups. Keeps the limits, because podman cannot
# raise them inside a container.
if [ "${1:-}" != inside ] && [ "${1:-}" != running ]; then
  [ "$(id -u)" = 0 ] || die "needs root"
  command -v podman >/dev/null || die "needs podman: apt-get install podman"
  folder=$(mktemp -d)
  trap 'rm -rf "$folder"' EXIT
  python3 -m venv "$folder"
  "$folder/bin/pip" install -q podman-compose  # Debian 12's does not know a network that is the host's
  printf '[containers]\ndefault_ulimits = ["nofile=%s:%s", "nproc=4096:4096"]\n[engine]\ncgroup_manager = "cgroupfs"\n' \
    "$(ulimit -Hn)" "$(ulimit -Hn)" >"$folder/containers.conf"
  PATH=$folder/bin:$PATH CONTAINERS_CONF=$folder/containers.conf unshare --mount "$0" inside
  exit
fi
if [ "$1" = inside ]; then
  ! mountpoint -q /sys/fs/cgroup/unified || umount /sys/fs/cgroup/unified
  cd "$checkout"
  podman image exists ros:jazzy-ros-base || make_base
  build -f deploy/container/Dockerfile -t rover-router .
  exec unshare --net "$0" running
fi

# In the network namespace of the router's container.
ip link set lo up
for address in 192.168.0.{1,10,30,40,50,222}; do ip address add "$address/24" dev lo; done
work=$(mktemp -d)
clean() {
  podman rm --force --ignore "$container" >/dev/null 2>&1
  podman volume rm --force rover_recordings rover_state >/dev/null
  rm -rf "$work"
}
trap clean EXIT
cp -r tests/rover/routes deploy "$work"
cp -r tests/rover/protos "$work"
export ROUTER_TABLE=routes/rover.yaml  # one process with gateways: the tests' rover has no other table
compose=(podman-compose -f "$work/deploy/container/compose.yaml")

start() {  # [COMPOSE FILE...]
  "${compose[@]}" "$@" up --no-build --detach router >"$work/compose.log" 2>&1
}

tell() { printf '%-60s %s\n' "$1" "${2:-yes}"; }

look() {  # WHAT COMMAND...: ends the script where it fails
  local what=$1
  shift
  if ! "$@" >"$work/output" 2>&1; then
    podman logs "$container" 2>&1 | tail -n 20
    cat "$work/output" "$work/compose.log"
    die "not so: $what"
  fi
  tell "$what"
}

eventually() { for _ in $(seq 120); do ! "$@" || return 0; sleep 0.5; done; return 1; }
inside() { podman exec "$container" "$@"; }
logs() { podman logs "$container" 2>&1 | grep -q "$1"; }
has_exited_with() { [ "$(podman inspect "$container" --format '{{.State.ExitCode}}')" = "$1" ]; }
may_do_nothing() { [ "$(inside grep -cE '^Cap(Eff|Bnd):\s0{16}$' /proc/1/status)" = 2 ]; }
is_first_process() { inside readlink /proc/1/exe | grep -q python; }

podman --version
podman-compose --version 2>/dev/null | head -n 1
podman image inspect rover-router --format 'image of {{.Size}} bytes, {{.Architecture}}'
podman image inspect ros:jazzy-ros-base --format 'of which the base {{.Size}}'

start
look "it starts, and /ready answers" eventually curl -sf 127.0.0.1:9108/ready
look "the health check is content" podman healthcheck run "$container"
look "/metrics counts" grep -q ^router_ <(curl -s 127.0.0.1:9108/metrics)
look "it is process 1, without a shell around it" is_first_process
look "it runs as user 1000" test "$(inside id -u)" = 1000
look "it has no capabilities" may_do_nothing
look "its root is read-only" bash -c "! podman exec $container touch /opt/rover_router/file"
look "router doctor works beside it, and loads ROS" inside router doctor
router sim --for 15s -t tests/rover/routes/rover.yaml >"$work/sim" 2>&1 &
look "ROS topics have what boards send" inside router listen topic://imu_data --count 1 --for 10s
look "its last minute is saved" inside router record --last
look "recordings are in the volume" bash -c "ls $(podman volume inspect rover_recordings --format '{{.Mountpoint}}')/*.mcap"
wait $!
look "boards obey" grep -q "driving_board obeys" "$work/sim"
podman kill --signal HUP "$container" >/dev/null
look "SIGHUP reloads the table" eventually logs 'reload'
router listen envelope://192.168.0.222:8 >"$work/board" 2>&1 &
listening=$!
sleep 2
before=$(grep -c 'manual_brake.*brake=true' "$work/board" || true)
started=$(date +%s%N)
podman stop --time 10 "$container" >/dev/null 2>&1
took=$((($(date +%s%N) - started) / 1000000))
look "SIGTERM ends it with 0" has_exited_with 0
tell "in" "$took ms"
sleep 0.5
kill $listening
look "the brake has left" test "$(grep -c 'manual_brake.*brake=true' "$work/board")" -gt "$before"
podman rm "$container" >/dev/null 2>&1

echo 'routs: {}' >>"$work/routes/rover.yaml"
sed -i '/restart:/d' "$work/deploy/container/compose.yaml"
start
look "a table with errors ends it with 78" eventually has_exited_with 78
podman rm "$container" >/dev/null 2>&1

cp tests/rover/routes/rover.yaml "$work/routes"
if prlimit --rtprio=1 true 2>/dev/null; then
  start -f "$work/deploy/container/realtime.yaml"
  look "with realtime.yaml it starts" eventually curl -sf 127.0.0.1:9108/ready
  podman exec --user 0 "$container" cat /proc/1/limits | grep -i "realtime priority"
else
  start -f "$work/deploy/container/realtime.yaml" || true
  look "with realtime.yaml this engine does not start it, since it may not raise the limit" \
    bash -c "! [ \"\$(podman inspect $container --format '{{.State.Running}}')\" = true ]"
fi
