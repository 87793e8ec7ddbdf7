#!/usr/bin/env bash
# Installs router and gateways of this checkout as systemd services, and starts them. `make install-service` runs it;
# needs root.
#
#   deploy/install-service.sh [TABLE [GATEWAYS]]
#
# TABLE is the router's, at first routes/rover-router.yaml. GATEWAYS is the table of a second service, at first
# routes/rover-gateways.yaml; `none` for no second service. If TABLE has gateways itself, there is none either. Run it
# again after changing the address or interface of a listener, `record.directory`, or the path of the checkout, and
# after adding the first serial line.
#
# It writes rover-router.service, .socket and -hold.service and rover-gateways.service to /etc/systemd/system, creates
# /etc/default/rover-router if it does not exist, and adds the user rover-router. Listeners on an interface, for example wg0, get a unit
# rover-router-wg0.socket, and the interface's device unit a shorter timeout. docs/guides/deploy.md describes how to
# operate and remove the service.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
units=/etc/systemd/system
settings=/etc/default/rover-router
user=rover-router

die() {
  printf 'install-service: %s\n' "$@" >&2
  exit 1
}

# Paths are written to units and to settings that shell and systemd read, and pass through sed.
check_place() {
  case $1 in
    *[[:space:][:cntrl:]\|\&\\\"\'\`\$%\;\#*?\<\>\(\)]*) die "'$1' has characters that systemd or a shell would misread: move it" ;;
  esac
}

check_place "$root"
[ "$(id -u)" = 0 ] || die "needs root: sudo make install-service"
[ -x "$root/.venv/bin/router" ] || die "$root has no .venv yet: run 'make setup' first, as your own user"
command -v systemctl >/dev/null || die "this computer has no systemd"

chosen=
gateways=
if [ $# -gt 0 ]; then
  chosen=$(realpath -e "$1") || die "there is no table $1"
  check_place "$chosen"
fi
if [ $# -gt 1 ]; then
  gateways=none
  [ "$2" = none ] || gateways=$(realpath -e "$2") || die "there is no table $2"
  check_place "$gateways"
fi

echo "install-service: runs code of $root as root, which '$(stat -c %U "$root")' can change: .venv/env.sh," \
  ".venv/bin/python and router/; it also runs $settings; the service runs as '$user'"

set -a
RECORDINGS=/var/lib/$user  # as in the unit; the settings may change it
ROUTER_TABLE=$root/routes/rover-router.yaml
GATEWAYS_TABLE=$root/routes/rover-gateways.yaml
# shellcheck disable=SC1090
if [ -e "$settings" ]; then . "$settings"; fi
ROUTER_TABLE=${chosen:-$ROUTER_TABLE}
GATEWAYS_TABLE=${gateways:-${GATEWAYS_TABLE:-none}}
set +a

# Print what a unit needs from its TABLE: lines "socket ADDRESS INTERFACE" (- for none), "line DEVICE", "write FOLDER",
# "read FOLDER", and "gateways" if it has some. Findings go to stderr.
facts_of() {
  set +u  # ROS's script reads variables that nobody set
  # shellcheck disable=SC1091
  . "$root/.venv/env.sh"
  set -u
  "$root/.venv/bin/python" - "$root" "$1" <<'END'
import sys
from pathlib import Path
from router.cli.findings import print_findings
from router.compiler import check_table
from router.hosts import zone

checked = check_table(Path(sys.argv[2]))
print_findings(checked.diagnostics, sys.stderr)
if checked.program is None:
    sys.exit(78)
table = checked.program.table
if table.gateways:
    print("gateways")
for listener in table.sockets:
    if not zone(listener.address.value.host):  # systemd ignores an interface that is not there when it reads the unit
        print("socket", listener.address.value, listener.interface or "-")
for line in table.lines:
    print("line", line.address.value)
if table.record is not None and (directory := table.record.directory.resolve()) != Path("/var/lib/rover-router"):
    print("write", directory)
read = {Path(sys.argv[1]), Path(sys.base_prefix), *(file.resolve().parent for file in table.files)}
for folder in sorted(read):
    if folder.parts[:2] in (("/", "home"), ("/", "root")) and read.isdisjoint(folder.parents):
        print("read", folder)
END
}

unusable() {  # STATUS of facts_of
  case $1 in
    78) die "nothing was changed: the table has errors" ;;
    *) die "nothing was changed: the table could not be checked" ;;
  esac
}

facts=$(facts_of "$ROUTER_TABLE") || unusable $?
if grep -q '^gateways' <<<"$facts"; then
  [ "${gateways:-none}" = none ] || die "nothing was changed: $ROUTER_TABLE has gateways itself: leave out $gateways," \
    "or name a table without gateways, such as routes/rover-router.yaml"
  echo "install-service: the router also runs the gateways of $ROUTER_TABLE; for a process of their own, choose" \
    "routes/rover-router.yaml"
  GATEWAYS_TABLE=none
fi
if [ "$GATEWAYS_TABLE" != none ]; then
  gateway_facts=$(facts_of "$GATEWAYS_TABLE") || unusable $?
fi

id "$user" >/dev/null 2>&1 || useradd --system --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin "$user"

if [ ! -e "$settings" ]; then
  cat >"$settings" <<END
# Environment of rover-router.service and rover-gateways.service, read at each start. After changing a table, or the
# addresses of its listeners, run deploy/install-service.sh again.
ROUTER_TABLE=$root/routes/rover-router.yaml
GATEWAYS_TABLE=$root/routes/rover-gateways.yaml
ROS_DOMAIN_ID=0
#ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET
#BASESTATION=192.168.0.10:9000
END
fi
remember() {  # VARIABLE VALUE
  if grep -q "^$1=" "$settings"; then
    sed -i "s|^$1=.*|$1=$2|" "$settings"
  else
    sed -i '$a\' "$settings"  # ends the last line
    echo "$1=$2" >>"$settings"
  fi
}
[ -z "$chosen" ] || remember ROUTER_TABLE "$chosen"
[ -z "$gateways" ] || remember GATEWAYS_TABLE "$gateways"

# A socket unit has one BindToDevice=, and needs a service of its own, so each interface has a pair of units.
new=$(mktemp -d)
trap 'rm -r "$new"' EXIT
sockets=()
rm -f "$units"/*.device.d/rover-router.conf  # of a previous table
while read -r interface; do
  on=${interface:+-$interface}
  sockets+=("rover-router$on.socket")
  for unit in rover-router.socket rover-router-hold.service; do
    sed -e "s|rover-router\.socket|rover-router$on.socket|g; s|rover-router-hold\.service|rover-router-hold$on.service|g" \
      "$root/deploy/systemd/$unit" >"$new/${unit%.*}$on.${unit##*.}"
  done
  addresses=$(printf '%s\n' "$facts" | awk -v on="${interface:--}" '$1 == "socket" && $3 == on { print "ListenDatagram=" $2 }')
  if [ -n "$interface" ]; then
    addresses+=$'\n'"BindToDevice=$interface"
    # systemd waits for the interface at each start of the service, even after a crash. Do not wait 90 s: the router
    # opens the listener when the interface appears.
    device=$units/$(systemd-escape --path --suffix=device "/sys/subsystem/net/devices/$interface").d
    mkdir -p "$device"
    printf '# Written by deploy/install-service.sh.\n[Unit]\nJobRunningTimeoutSec=10s\n' >"$device/rover-router.conf"
  fi
  awk -v addresses="$addresses" '/^ListenDatagram=/ { print addresses; next } { print }' \
    "$new/rover-router$on.socket" >"$new/filled"
  mv "$new/filled" "$new/rover-router$on.socket"
done < <(printf '%s\n' "$facts" | awk '$1 == "socket" { print $3 == "-" ? "" : $3 }' | sort -u)
sed -e "s|/opt/rover-router|$root|g; s|^Sockets=.*|Sockets=${sockets[*]}|" "$root/deploy/systemd/rover-router.service" \
  >"$new/rover-router.service"

# Home folders are hidden from a service, except for the paths that it needs.
open_places() {  # SERVICE FACTS
  mkdir -p "$units/$1.d"
  {
    printf '# Written by deploy/install-service.sh.\n[Service]\n'
    printf '%s\n' "$2" | sed -n 's/^read /BindReadOnlyPaths=/p; s/^write /BindPaths=/p'
  } >"$units/$1.d/places.conf"
}
open_places rover-router.service "$facts"
if grep -q '^line ' <<<"$facts"; then
  install -m 644 "$root/deploy/systemd/serial-lines.conf" "$units/rover-router.service.d"
else
  rm -f "$units/rover-router.service.d/serial-lines.conf"  # of a previous table
fi
if [ "$GATEWAYS_TABLE" != none ]; then
  open_places rover-gateways.service "$gateway_facts"
  sed "s|/opt/rover-router|$root|g" "$root/deploy/systemd/rover-gateways.service" >"$new/rover-gateways.service"
elif [ -e "$units/rover-gateways.service" ]; then  # of an earlier installation
  systemctl disable --quiet --now rover-gateways.service
  rm -r "$units"/rover-gateways.service{,.d}
fi
printf '%s\n' "$facts" | sed -n 's/^write //p' | while read -r folder; do
  [ -d "$folder" ] || install -d -o "$user" -g "$user" "$folder"
done

same_sockets=yes
for socket in "${sockets[@]}"; do cmp -s "$new/$socket" "$units/$socket" || same_sockets=no; done
for unit in "$units"/rover-router*.socket "$units"/rover-router-hold*.service; do  # of a previous table
  if [ -e "$unit" ] && [ ! -e "$new/${unit##*/}" ]; then
    same_sockets=no
    systemctl stop "${unit##*/}"
    rm "$unit"
  fi
done
install -m 644 "$new"/* "$units"
systemctl daemon-reload
if [ $same_sockets = no ]; then systemctl stop rover-router.service "${sockets[@]}"; fi
start() {  # SERVICE
  systemctl enable --quiet "$1.service"
  systemctl restart "$1.service" || die "the service did not start; see: journalctl -u $1 -e"
  echo "install-service: $1 is running; see: systemctl status $1, journalctl -u $1 -f"
}
start rover-router
[ "$GATEWAYS_TABLE" = none ] || start rover-gateways
