#!/usr/bin/env bash
# Writes keys and configuration of a WireGuard tunnel between the rover and its basestations.
#
#   deploy/wireguard/keys.sh ROVER [BASESTATION...]
#
# ROVER is the rover's address or host name on the radio, such as 192.168.1.20 or 192.168.1.20:51820. Each BASESTATION
# is a name; the default is `basestation`. The script writes keys/NAME/wg0.conf beside itself for each computer (git
# ignores keys/). Move each file to /etc/wireguard/wg0.conf on its computer. Further runs with other names add these to
# the rover's file and keep the existing ones. docs/guides/security.md describes the tunnel.
set -euo pipefail
umask 077
keys=${KEYS:-$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)/keys}
network=10.77.0

die() {
  printf 'keys: %s\n' "$@" >&2
  exit 1
}

[ $# -ge 1 ] || die "give the rover's address on the radio: $0 192.168.1.20 [BASESTATION...]"
command -v wg >/dev/null || die "needs wg: apt install wireguard-tools"
endpoint=$1
shift
[[ $endpoint =~ ^[A-Za-z0-9.-]+(:[0-9]+)?$ ]] || die "'$endpoint' is not an address"
[[ $endpoint == *:* ]] || endpoint+=:51820
[ $# -ge 1 ] || set -- basestation
for name in "$@"; do
  [[ $name =~ ^[A-Za-z0-9_-]+$ && $name != rover ]] || die "'$name' cannot be the name of a basestation: use letters, digits, - and _, but not 'rover'"
  [ ! -e "$keys/$name" ] || die "$name already has keys: to make new ones, remove $keys/$name and its [Peer] in rover/wg0.conf"
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
