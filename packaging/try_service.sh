#!/bin/sh
# Tries the service of the Debian package under systemd, in a container of its own: start, crash,
# hang, too many crashes, full disk, a radio that is late and then unplugged, a wall clock that is set
# back, bad options.
#
#   sudo packaging/try_service.sh ROOT PACKAGE.deb
#
# ROOT is as for try_in_root.sh; it needs systemd-nspawn (Debian: systemd-container) and cc. The
# container has a network of its own with nothing but itself. It has the devices and the clock of its
# host: so the radio's serial port is a pseudo terminal that goes away, and the clock is moved for the
# service alone, by tests/e2e/moved_clock.c. The package is purged at the end.
set -eu

root=${1:?usage: try_service.sh ROOT PACKAGE.deb} package=${2:?usage: try_service.sh ROOT PACKAGE.deb}
log=$(mktemp)

cp "$package" "$root/tmp/companion.deb"
chroot "$root" dpkg --install /tmp/companion.deb >"$log"
echo 'COMPANION_OPTIONS=--connect udp:127.0.0.1:14540' >"$root/etc/companion/service.env"
systemd-nspawn --quiet --directory "$root" --private-network --register=no --keep-unit --boot \
    >"$log" 2>&1 </dev/null &
container=$!
end() {
    kill -TERM "$container" 2>/dev/null || true
    wait "$container" || true
    chroot "$root" dpkg --purge companion-guidance >/dev/null
    rm -rf "$log" "$root/etc/systemd/system/companion.service.d" "$root/etc/deaf.yaml"
}
trap end EXIT

leader=
for _ in $(seq 60); do
    leader=$(pgrep -P "$container" | head -1) || true
    [ -n "$leader" ] && grep -q 'Multi-User System' "$log" && break
    sleep 1
done

inside() {
    nsenter --target "$leader" --all env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/tmp "$@"
}

property() {
    inside systemctl show companion --property "$1" --value
}

# What it must be, within seconds: until PROPERTY VALUE SECONDS.
until_is() {
    for _ in $(seq "$3"); do
        [ "$(property "$1")" = "$2" ] && return
        sleep 1
    done
    echo "$1 is $(property "$1"), not $2" >&2
    inside journalctl --unit companion --no-pager --lines 20 >&2
    exit 1
}

start() {
    inside systemctl reset-failed companion 2>/dev/null || true
    inside systemctl start companion
    until_is ActiveState active 60
}

inside systemd-run --quiet --unit sim sim-link
start
echo "started as $(inside stat -c %U "/proc/$(property MainPID)"), $(property StatusText)"
# Of proc_pid_stat(5): niceness, rt_priority, and the policy, 2 for SCHED_RR.
limit=$(inside awk '/realtime priority/ {print $4}' "/proc/$(property MainPID)/limits")
case "$limit $(inside cut -d ' ' -f 19,40,41 "/proc/$(property MainPID)/stat")" in
    1\ *\ 1\ 2) echo 'real-time priority 1, as its unit allows' ;;
    0\ -10\ 0\ 0) echo 'nice -10: where this runs, no limit of real-time priority can be raised' ;;
    *) echo "neither real-time priority nor nice -10" >&2; exit 1 ;;
esac
exposure=$(inside systemd-analyze security --no-pager companion | sed -n 's/.*exposure level.*: \([0-9.]*\) .*/\1/p')
awk "BEGIN {exit !(0 < $exposure && $exposure <= 3.5)}" || { echo "exposure $exposure, over 3.5" >&2; exit 1; }
echo "exposure $exposure by systemd-analyze security"

inside systemctl kill --signal KILL companion
until_is NRestarts 1 20
until_is ActiveState active 60
echo "killed: started again"

inside systemctl kill --signal STOP companion
until_is NRestarts 2 20
until_is ActiveState active 60
echo "hung: ended by the watchdog, started again"

inside systemctl kill --signal KILL companion
until_is ActiveState failed 20
echo "a third time within a minute: left alone ($(property Result))"

inside systemctl stop companion 2>/dev/null || true
inside mount -t tmpfs -o size=3m,mode=777 tmpfs /var/lib/companion
start
inside sh -c 'head -c 4m /dev/zero >/var/lib/companion/filler 2>/dev/null || true'
sleep 15
until_is ActiveState active 1
[ "$(property NRestarts)" = 0 ]
echo "disk full: flies on; $(inside journalctl --unit companion --no-pager --output cat --grep 'log entries lost' | tail -1)"
inside systemctl stop companion
inside umount /var/lib/companion

# What the journal says from now on: await TEXT SECONDS.
listen() {
    sleep 1
    began_s=$(date +%s)
}
await() {
    for _ in $(seq "$2"); do
        inside journalctl --unit companion --no-pager --output cat --since "@$began_s" | grep -q "$1" && return
        sleep 1
    done
    echo "the journal does not say \`$1\`" >&2
    inside journalctl --unit companion --no-pager --lines 20 >&2
    exit 1
}

plug_in() {
    inside systemd-run --quiet --unit radio --property User=companion --property RuntimeDirectory=uwb \
        sim-link radio --follow tcp:127.0.0.1:14030 --as nlink_aoa --to pty:/run/uwb/port
}

inside systemctl stop sim
echo 'payload: {max_range_m: 0.001}' >"$root/etc/deaf.yaml"
inside systemd-run --quiet --unit sim sim-link --scenario /etc/deaf.yaml \
    --send-to 127.0.0.1:14540 --link tcpin:127.0.0.1:14030
echo 'COMPANION_OPTIONS=--connect udp:127.0.0.1:14540 --radio nlink@serial:/run/uwb/port:921600' \
    >"$root/etc/companion/service.env"
listen
start
await 'radio nlink: silent' 20
plug_in
await 'radio nlink: is heard again' 40
echo 'radio late: the service waits for it'
listen
inside systemctl stop radio
await 'radio nlink: silent' 20
inside systemctl kill --signal KILL companion
until_is NRestarts 1 20
until_is ActiveState active 60
listen
await 'radio nlink: silent' 20
plug_in
await 'radio nlink: is heard again' 40
[ "$(property NRestarts)" = 1 ]
echo 'radio unplugged: reported; killed then, it started again without it; plugged in: heard again'
inside systemctl stop companion radio

echo 'COMPANION_OPTIONS=--connect udp:127.0.0.1:14540' >"$root/etc/companion/service.env"
cc -O2 -shared -fPIC -o "$root/opt/companion/moved_clock.so" "$(dirname "$0")/../tests/e2e/moved_clock.c"
mkdir -p "$root/etc/systemd/system/companion.service.d"
variables='LD_PRELOAD=/opt/companion/moved_clock.so MOVED_CLOCK=/run/moved_clock'
printf '[Service]\nEnvironment=%s\n' "$variables" >"$root/etc/systemd/system/companion.service.d/clock.conf"
inside systemctl daemon-reload
inside sh -c 'rm -rf /var/lib/companion/*; echo 86400 >/run/moved_clock'
start
sleep 5
inside sh -c 'echo 0 >/run/moved_clock'
sleep 10
until_is ActiveState active 1
[ "$(property NRestarts)" = 0 ]
listen
inside systemctl kill --signal KILL companion
until_is NRestarts 1 20
await 'resumed after [0-9]* s in' 60
[ "$(inside ls /var/lib/companion/flights | wc -l)" = 2 ]
echo 'clock set back by a day: flew on; killed then, it knew how long it had been away'
inside systemctl stop companion

echo 'COMPANION_OPTIONS=--connect nonsense:1' >"$root/etc/companion/service.env"
inside systemctl reset-failed companion 2>/dev/null || true
inside systemctl start companion 2>/dev/null || true
until_is ActiveState failed 20
[ "$(property ExecMainStatus)" = 2 ] && [ "$(property NRestarts)" = 0 ]
echo "bad options: exit code 2, not tried again"
