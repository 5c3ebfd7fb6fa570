#!/bin/sh
# Makes .venv with both distributions (editable) and one extra of the first; does nothing if it is
# there.
#
#   tools/release/make_venv.sh demo|dev|package
#
# Needs a Python of at least 3.11 with pip, and the network the first time. PYTHON names the
# interpreter; otherwise python3, then python3.14 to python3.11 are tried.
set -eu

cd "$(dirname "$0")/../.."
extra=${1:?usage: tools/release/make_venv.sh demo|dev|package}
venv=.venv
venv_python=$venv/bin/python
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_USER=0 PIP_NO_INPUT=1

fail() {
    echo "make_venv: $*" >&2
    exit 1
}

is_new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        is_new_enough "$PYTHON" || fail "PYTHON=$PYTHON is not a Python of at least 3.11"
        echo "$PYTHON"
        return
    fi
    for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
        if is_new_enough "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    fail "no Python of at least 3.11 found; install one, or name it: make PYTHON=/path/to/python3 ..."
}

# A stamp is what was installed, the pyproject.toml of both distributions: a changed file is
# installed again, one that was only checked out again is not. Everything of demo is part of dev.
print_stamp() {
    cat pyproject.toml sim_link/pyproject.toml
}

is_installed() {
    print_stamp | cmp -s - "$venv/.installed-$1"
}

# A virtual environment knows its path by heart: one that was moved or copied is made again.
is_usable() {
    is_new_enough "$venv_python" &&
        { [ ! -f "$venv/.place" ] || [ "$(cat "$venv/.place")" = "$(pwd)" ]; }
}

make_venv() {
    python=$1
    "$python" -c 'import venv' 2>/dev/null || fail "$python has no venv module; install it"
    trap 'rm -rf "$venv"' EXIT
    trap 'exit 1' INT TERM HUP
    # Debian splits ensurepip off; then the pip of the interpreter installs into the new one.
    "$python" -m venv --clear "$venv" >/dev/null 2>&1 ||
        "$python" -m venv --clear --without-pip "$venv" ||
        fail "$python cannot make a virtual environment"
    pwd >"$venv/.place"
    trap - EXIT INT TERM HUP
}

install() {
    if "$venv_python" -m pip --version >/dev/null 2>&1; then
        "$venv_python" -m pip "$@"
        return
    fi
    python=$(find_python)
    for pip in "$python -m pip" "pip3" "pip"; do
        if $pip --python "$venv_python" --version >/dev/null 2>&1; then
            $pip --python "$venv_python" "$@"
            return
        fi
    done
    fail "$python has no pip (22.3 or newer); install it (Debian: apt install python3-pip)"
}

if is_usable; then
    if is_installed dev || is_installed "$extra"; then
        exit 0
    fi
else
    if [ -e "$venv" ] && [ ! -f "$venv/pyvenv.cfg" ]; then
        fail "$venv is there but is not a virtual environment; move it away"
    fi
    python=$(find_python)
    echo "making $venv with $("$python" --version)"
    make_venv "$python"
fi

echo "installing the project and its $extra packages into $venv (once)"
rm -f "$venv/.installed-$extra"
case $extra in
demo) extras=demo,web ;; # the live map belongs to it
*) extras=$extra ;;
esac
# In one command: then pip finds companion-sim-link here, and looks for it nowhere else.
install install --quiet --editable ".[$extras]" --editable ./sim_link ||
    fail "the install failed, see above; run it again"
print_stamp >"$venv/.installed-$extra.part"
mv "$venv/.installed-$extra.part" "$venv/.installed-$extra"
