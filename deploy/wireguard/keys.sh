#!/usr/bin/env bash
# Makes the keys and the configuration of a WireGuard tunnel between the rover and its basestations.
#
#   deploy/wireguard/keys.sh ROVER [BASESTATION...]
#
# ROVER is the address (or name) by which basestations reach the rover over the radio, 192.168.1.20 or 192.168.1.20:51820.
# Each BASESTATION is a name, `basestation` unless said. For each computer there is then a folder NAME/wg0.conf beside
# this script, in keys/, which git ignores: copy it to /etc/wireguard/wg0.conf there, and remove it here. Run again with
# other names, it adds these to the rover's file and leaves the others as they are. docs/guides/security.md tells the rest.
set -euo pipefail
umask 077
keys=${KEYS:-$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)/keys}
network=10.77.0

die() {
  printf 'keys: %s\n' "$@" >&2
  exit 1
}

[ $# -ge 1 ] || die "say by which address the rover is reached: $0 192.168.1.20 [BASESTATION...]"
command -v wg >/dev/null || die "needs wg: apt install wireguard-tools"
endpoint=$1
shift
[[ $endpoint =~ ^[A-Za-z0-9.-]+(:[0-9]+)?$ ]] || die "'$endpoint' is no address"
[[ $endpoint == *:* ]] || endpoint+=:51820
[ $# -ge 1 ] || set -- basestation
for name in "$@"; do
  [[ $name =~ ^[A-Za-z0-9_-]+$ && $name != rover ]] || die "'$name' is no name for a basestation"
  [ ! -e "$keys/$name" ] || die "$name has keys already: remove $keys/$name, and its [Peer] in rover/wg0.conf, for new ones"
done

rover=$keys/rover/wg0.conf
if [ ! -e "$rover" ]; then
  mkdir -p "$keys/rover"
  cat >"$rover" <<END
[Interface]
Address = $network.1/24
ListenPort = ${endpoint##*:}
PrivateKey = $(wg genkey)
MTU = 1420
END
fi
public=$(sed -n 's/^PrivateKey = //p' "$rover" | wg pubkey)
for name in "$@"; do
  number=$(sed -n "s|^AllowedIPs = $network\.\([0-9]*\)/32|\1|p" "$rover" | sort -n | tail -1)
  number=$((${number:-9} + 1))
  private=$(wg genkey)
  mkdir "$keys/$name"
  cat >"$keys/$name/wg0.conf" <<END
[Interface]
Address = $network.$number/24
PrivateKey = $private
MTU = 1420

[Peer]
# the rover
PublicKey = $public
Endpoint = $endpoint
AllowedIPs = $network.1/32
PersistentKeepalive = 5
END
  cat >>"$rover" <<END

[Peer]
# $name
PublicKey = $(wg pubkey <<<"$private")
AllowedIPs = $network.$number/32
END
  echo "keys: $name is $network.$number in the tunnel: $keys/$name/wg0.conf"
done
echo "keys: the rover is $network.1: $rover"
