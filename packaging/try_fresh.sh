#!/bin/sh
# Builds the Debian package on a fresh Debian 12 with nothing but what docs/install.md names, then tries it
# on another one with nothing but what the package depends on (try_in_root.sh).
#
#   sudo packaging/try_fresh.sh [CACHE]
#
# The roots come of debootstrap and of the mirror that this machine's apt uses, or DEBIAN_MIRROR. They are
# kept in CACHE (~/.cache/companion-guidance/debian) for the next time; delete it to fetch newer packages.
# The package is left in dist. Some ten minutes of two cores. Where it cannot run it says why, and its exit code is 0.
set -eu

cd "$(dirname "$0")/.."
cache=${1:-${XDG_CACHE_HOME:-$HOME/.cache}/companion-guidance/debian}
suite=bookworm

skip() {
    echo "SKIPPED, the Debian package was neither built nor tried: $*"
    exit 0
}

[ "$(id -u)" = 0 ] || skip "needs root for chroot"
unshare --net --mount --pid --fork true 2>/dev/null || skip "this container may not make namespaces"
if ! command -v debootstrap >/dev/null; then
    command -v apt-get >/dev/null || skip "needs debootstrap"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends debootstrap >/dev/null
fi

mirror() { # of the first Debian suite proper; those of updates have a hyphen in their names
    apt-get indextargets --format '$(RELEASE) $(REPO_URI)' 'Created-By: Packages' |
        awk '$1 !~ /-/ {print $2; exit}'
}
mirror=${DEBIAN_MIRROR:-$(. /etc/os-release && [ "$ID" = debian ] && mirror || true)}
[ -n "$mirror" ] || skip "apt has no mirror of Debian here; name one in DEBIAN_MIRROR"

scratch=$(mktemp -d -p "${TMPDIR:-/var/tmp}" companion-deb.XXXXXX)
trap 'rm -rf --one-file-system "$scratch"' EXIT
trap 'exit 1' INT TERM HUP

fresh() { # fresh NAME PACKAGES: a root at $scratch/NAME
    kept=$cache/$suite-$(echo "$2" | cksum | cut -d' ' -f1).tar
    if [ ! -f "$kept" ]; then
        echo "making a Debian root with $2 (once)"
        debootstrap --variant=minbase --include="$2" "$suite" "$scratch/$1" "$mirror" >"$scratch/$1.log" ||
            { tail -20 "$scratch/$1.log" >&2; exit 1; }
        rm -rf "$scratch/$1"/var/cache/apt/* "$scratch/$1"/var/lib/apt/lists/*
        mkdir -p "$cache"
        tar -C "$scratch" -cf "$kept.part" "$1"
        mv "$kept.part" "$kept"
        rm -rf "${scratch:?}/$1"
    fi
    mkdir -p "$scratch/$1"
    tar -C "$scratch/$1" --strip-components=1 -xf "$kept"
}

named=$(sed -n 's/^sudo apt install \(.*\bmake\b.*\)/\1/p' docs/install.md | tr ' ' ,)
[ -n "$named" ] || { echo "docs/install.md does not say what make deb needs" >&2; exit 1; }
fresh builder "$named"
mkdir "$scratch/builder/src"
git -c safe.directory='*' ls-files -z --cached --others --exclude-standard | xargs -0 ls -d 2>/dev/null |
    tar -c -T - | tar -C "$scratch/builder/src" -x

# It has this machine's way to the package index of Python: names, certificates, settings of pip.
cp -L /etc/resolv.conf "$scratch/builder/etc/resolv.conf"
! [ -f /etc/pip.conf ] || cp /etc/pip.conf "$scratch/builder/etc/pip.conf"
home=$scratch/builder/home/builder
mkdir -p "$HOME/.cache/pip" "$home/.cache/pip" "$home/.config"
! [ -d "$HOME/.config/pip" ] || cp -r "$HOME/.config/pip" "$home/.config"
settings=$(env | grep -iE '^(pip_|[a-z]+_proxy=|ssl_cert_)' || true)
began_s=$(date +%s)
(
    IFS='
'
    unshare --mount --pid --fork --kill-child sh -c '
        mount -t proc proc "$0/proc"
        mount --bind /etc/ssl/certs "$0/etc/ssl/certs"
        mount --bind "$HOME/.cache/pip" "$0/home/builder/.cache/pip"
        exec chroot "$0" env -i HOME=/home/builder LC_ALL=C.UTF-8 PATH=/usr/sbin:/usr/bin:/sbin:/bin "$@" \
            make -C /src deb' "$scratch/builder" $settings
) >"$scratch/make.log" 2>&1 || { tail -30 "$scratch/make.log" >&2; exit 1; }
mkdir -p dist
cp "$scratch"/builder/src/dist/*.deb dist
package=$(cd "$scratch/builder/src/dist" && echo *.deb)
rm -rf "$scratch/builder"
echo "built after $(($(date +%s) - began_s)) s: dist/$package"
if grep '3\.11 gets kernels in plain Python' "$scratch/make.log"; then exit 1; fi

fresh vehicle python3,systemd,udev
# In slow motion: the package is tried, not how busy this machine is.
DEMO_ARGS=${DEMO_ARGS:---speed 0.5} packaging/try_in_root.sh "$scratch/vehicle" "dist/$package"
