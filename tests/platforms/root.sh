#!/usr/bin/env bash
# Runs a command in a root file system of another distribution, built once by debootstrap. Needs root.
#
#   tests/platforms/root.sh NAME [COMMAND...]     by default a shell
#
#   noble         Ubuntu 24.04, Python 3.12
#   jammy         Ubuntu 22.04, Python 3.10
#   trixie        Debian 13, Python 3.13
#   trixie-arm64  the same for aarch64, emulated by qemu-user-static
#
# Each has the packages that the README requires. They are in $ROUTER_ROOTS, by default ~/.cache/rover-router/roots.
# This checkout is at /checkout, read-only: clone it. The command has this computer's network, but its own PID and mount
# namespaces. NEEDS="git curl" installs more packages first.
set -euo pipefail

die() {
  printf 'root.sh: %s\n' "$@" >&2
  exit 1
}

checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
roots=${ROUTER_ROOTS:-$HOME/.cache/rover-router/roots}
name=${1:-}
[ $# = 0 ] || shift
packages=python3-venv,python3-dev,build-essential,cmake,git,ca-certificates,iproute2,curl
script=
case $name in
  noble | jammy) script=gutsy suite=$name architecture=amd64 more=(--components=main,universe) ;;
  trixie) suite=trixie architecture=amd64 more=() ;;
  trixie-arm64) suite=trixie architecture=arm64 more=() ;;
  *) die "usage: $0 noble|jammy|trixie|trixie-arm64 [COMMAND...]" ;;
esac
[ "$(id -u)" = 0 ] || die "needs root"
[ "$(uname -m)" = x86_64 ] || die "needs an x86_64 computer"
command -v debootstrap >/dev/null || die "needs debootstrap: apt-get install debootstrap"
root=$roots/$name
keys=/usr/share/keyrings/ubuntu-archive-keyring.gpg

make_runnable() {  # programs of aarch64
  local register=/proc/sys/fs/binfmt_misc/register
  [ -e $register ] || mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
  [ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ] || cat /usr/lib/binfmt.d/qemu-aarch64.conf >$register 2>/dev/null \
    || die "needs qemu for aarch64: apt-get install qemu-user-static"
}

find_ubuntus_keys() {  # Debian has them in a package; where this computer's does not, the root of trixie fetches it
  [ ! -e $keys ] || return 0
  NEEDS=ubuntu-keyring "$0" trixie true
  keys=$roots/trixie$keys
}

build() {
  rm -rf --one-file-system "$root.new"
  # By default the distribution's own mirror.
  debootstrap --variant=minbase --arch=$architecture --include=$packages "${more[@]}" "$suite" "$root.new" '' $script \
    >"$root.log" 2>&1 || die "the root of $name could not be built: see $root.log"
  mv "$root.new" "$root"
}

if [ $architecture = arm64 ]; then make_runnable; fi
if [ -n "$script" ] && [ ! -d "$root" ]; then
  find_ubuntus_keys
  more+=("--keyring=$keys")
fi
mkdir -p "$roots"
exec 9>>"$root.lock"
flock 9
[ -d "$root" ] || build
exec 9>&-

# In its own mount and PID namespaces, which end with the command, with this computer's DNS and certificates.
enter='
set -e
root=$1 checkout=$2 needs=$3
shift 3
mount --make-rprivate /
mount --bind "$root" "$root"
mkdir -p "$root/checkout"
mount --bind -o ro "$checkout" "$root/checkout"
mount -t proc proc "$root/proc"
mount --rbind /sys "$root/sys"
mount --rbind /dev "$root/dev"
for each in tmp run dev/shm; do mount -t tmpfs -o mode=1777 tmpfs "$root/$each"; done
cp /etc/resolv.conf /etc/hosts "$root/etc"
[ ! -e /etc/ssl/certs/ca-certificates.crt ] || cp --remove-destination /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs"
in_root() { env -i $(env | grep -E "^(PIP_|[a-z]*_proxy=|TERM=)" || true) HOME=/root LANG=C.UTF-8 \
  PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin chroot "$root" "$@"; }
if [ -n "$needs" ]; then
  in_root sh -c "apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $needs" >&2
fi
in_root git config --global --add safe.directory "*"
in_root "$@"
'
[ $# -gt 0 ] || set -- bash
exec unshare --mount --pid --ipc --fork --kill-child bash -c "$enter" enter "$root" "$checkout" "${NEEDS:-}" "$@"
