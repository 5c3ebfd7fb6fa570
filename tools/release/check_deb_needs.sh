#!/bin/sh
# Says in one line what `make deb` lacks on this machine, before anything is downloaded or compiled.
set -eu

cd "$(dirname "$0")/../.."
python=.venv/bin/python
[ -x "$python" ] || python=${PYTHON:-python3}
missing=

needs() { # DEBIAN_PACKAGE COMMAND...: what fails without the package
    package=$1
    shift
    "$@" >/dev/null 2>&1 </dev/null || missing="$missing $package"
}

needs gcc gcc --version
needs g++ g++ --version
needs libc6-dev g++ -E -include cstdlib -x c++ -
needs binutils strip --version
needs dpkg dpkg-deb --version
needs python3-dev "$python" -c 'import sysconfig; open(sysconfig.get_paths()["include"] + "/Python.h")'
[ -d .venv ] || needs python3-venv "$python" -c 'import ensurepip'
if [ -n "$missing" ]; then
    echo "make deb: missing on this machine; sudo apt install$missing" >&2
    exit 1
fi
