#!/bin/sh
# Tries the Debian package in a root of its own: install, demo, setup by flags and its undoing, doctor,
# purge.
#
#   sudo packaging/try_in_root.sh ROOT PACKAGE.deb
#
# ROOT comes of: debootstrap --variant=minbase --include=python3,systemd,udev bookworm ROOT
# With --arch arm64 and qemu-user-static it is an arm64 one; that is slow: DEMO_ARGS='--speed 0.1'.
# It has no network here, so that nothing can be downloaded, and afterwards it is as it was: files
# that the package left are listed, and are a failure.
set -eu

root=${1:?usage: try_in_root.sh ROOT PACKAGE.deb} package=${2:?usage: try_in_root.sh ROOT PACKAGE.deb}

inside() {
    unshare --net --mount --pid --fork --kill-child sh -c '
        ip link set lo up 2>/dev/null || python3 -c "
import fcntl, socket, struct
fcntl.ioctl(socket.socket(), 0x8914, struct.pack(\"16sH14x\", b\"lo\", 1))"
        mount -t proc proc "$0/proc"
        mount -t tmpfs tmpfs "$0/dev/shm" 2>/dev/null || true
        exec chroot "$0" env -i HOME=/tmp/home LC_ALL=C.UTF-8 PATH=/usr/sbin:/usr/bin:/sbin:/bin sh -c "$1"
    ' "$root" "$1"
}

files() {
    find "$root" -xdev \( -path "$root/proc" -o -path "$root/tmp" -o -path "$root/dev" \
        -o -path "$root/var/lib/dpkg" -o -path "$root/var/log" -o -path "$root/var/cache" \) -prune \
        -o -printf '%P\n' | grep -vx opt | sort
}

mkdir -p "$root/tmp/home"
files >"$root/tmp/before"
cp "$package" "$root/tmp/companion.deb"
began_s=$(date +%s)
inside 'dpkg --install /tmp/companion.deb' >/dev/null
echo "installed after $(($(date +%s) - began_s)) s"
inside 'cd /tmp && companion demo --no-plot '"${DEMO_ARGS:-}"' --json /tmp/demo.json >/tmp/demo.log 2>&1' ||
    { tail -5 "$root/tmp/demo.log"; exit 1; }
grep LOCALISED "$root/tmp/demo.log"
echo "localised after $(($(date +%s) - began_s)) s"
link=udp:127.0.0.1:14540
inside "set -e; cd /tmp; sim-link >sim.log & until grep -q listening /tmp/sim.log; do sleep 1; done
    companion setup --autopilot px4 --connect $link --radio none --preset wifi_rtt --fence none
    grep -x 'COMPANION_OPTIONS=--connect $link' /etc/companion/service.env
    companion config show --changed --config /etc/companion/companion.yaml >/dev/null
    companion doctor --connect $link --config /etc/companion/companion.yaml
    companion setup --remove" >"$root/tmp/setup.log" 2>&1 || { cat "$root/tmp/setup.log"; exit 1; }
grep 'fit to fly' "$root/tmp/setup.log"
changed=$(inside 'dpkg --verify companion-guidance')
if [ -n "$changed" ]; then
    echo "the setup was removed, but the package is not as it was: $changed" >&2
    exit 1
fi
echo "set up, examined, and the setup undone: the package is as it was"
inside 'id -nG companion; dpkg --purge companion-guidance' >/dev/null
if inside 'getent passwd companion' >/dev/null; then
    echo "purged, but the user companion is still there" >&2
    exit 1
fi
files >"$root/tmp/after"
# dpkg takes /opt away with the last package in it.
if ! diff "$root/tmp/before" "$root/tmp/after"; then
    echo "purged, but the lines above differ" >&2
    exit 1
fi
echo "purged: nothing is left"
