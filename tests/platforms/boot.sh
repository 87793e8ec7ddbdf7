#!/usr/bin/env bash
# Boots a root file system of root.sh as a separate computer with systemd as process 1, and runs a command there. Needs
# root.
#
#   tests/platforms/boot.sh noble|trixie COMMAND...
#
# The kernel is User Mode Linux, an ordinary process, in which a service may raise its limits; a container here may not.
# The computer has only a loopback network. Changes of its root file system are lost.
set -euo pipefail

die() {
  printf 'boot.sh: %s\n' "$@" >&2
  exit 1
}

roots=${ROUTER_ROOTS:-$HOME/.cache/rover-router/roots}
kernel=$(command -v linux.uml) || die "needs User Mode Linux: apt-get install user-mode-linux"
modules=/usr/lib/uml/modules
name=${1:-}
[ $# -gt 1 ] || die "usage: $0 noble|trixie COMMAND..."
shift
root=$roots/$name
for each in lib/systemd/systemd lib/systemd/systemd-udevd usr/bin/dbus-daemon sbin/insmod usr/bin/ps; do
  [ -e "$root/$each" ] || NEEDS="systemd udev dbus kmod procps" "$(dirname "$0")/root.sh" "$name" true
done

# Shared folder, mounted at /host on the booted computer.
shared=$(mktemp -d)
init=$(mktemp -p "$root/var/tmp")
trap 'rm -rf "$shared" "$init"' EXIT
printf '%q ' "$@" >"$shared/command"
: >"$shared/output"

cat >"$init" <<END
#!/bin/sh
set -e
mount -t proc proc /proc
mount -t hostfs -o $modules none /mnt
insmod /mnt/\$(uname -r)/kernel/fs/overlayfs/overlay.ko
umount /mnt
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
cd /mnt/root
mkdir -p host old lib/modules
mount -t hostfs -o $shared none host
mount -t hostfs -o $modules none lib/modules
cat >etc/systemd/system/command.service <<UNIT
[Unit]
After=basic.target systemd-udev-settle.service
[Service]
Type=oneshot
WorkingDirectory=/root
Environment=HOME=/root LANG=C.UTF-8 BOOTED=1
ExecStart=/bin/bash -c '(. /host/command); echo \\\$\\\$? >/host/status; systemctl poweroff -ff'
StandardOutput=append:/host/output
StandardError=append:/host/output
TimeoutStartSec=infinity
UNIT
mkdir -p etc/systemd/system/multi-user.target.wants
ln -s ../command.service etc/systemd/system/multi-user.target.wants
ln -sf /lib/systemd/system/multi-user.target etc/systemd/system/default.target
echo $name >etc/hostname
: >etc/machine-id  # without the file it would be the first boot, which enables everything
umount /proc
pivot_root . old
exec /lib/systemd/systemd --show-status=0
END
chmod +x "$init"

"$kernel" mem=3G root=/dev/root rootfstype=hostfs "rootflags=$root" rw "init=${init#"$root"}" quiet \
  con=null con0=null,fd:1 ssl=null </dev/null >"$shared/console" 2>&1 &
booted=$!
tail --pid=$booted -n +1 -s 0.2 -f "$shared/output"
wait $booted || true
[ -e "$shared/status" ] || { cat "$shared/console" >&2; die "the command did not end"; }
exit "$(cat "$shared/status")"
