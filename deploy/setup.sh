#!/bin/sh
# Create the virtual environment $1 from constraints.txt.  Called by `make setup`.
# Installs Debian's python3-venv where the interpreter cannot make an environment by itself and we may install it.
set -eu
venv=$1
python=${PYTHON:-python3.11}
here=$(dirname "$0")
constraints=$here/../constraints.txt

command -v "$python" >/dev/null || {
    echo "setup: $python is missing: install Python 3.11, or name another one with 'make setup PYTHON=...'" >&2
    exit 3
}
# pybullet, the physics of the plant, has wheels up to CPython 3.11 only.
"$python" - <<'PY' || exit 3
import sys
if sys.version_info[:2] != (3, 11):
    sys.exit(f"setup: the plant needs Python 3.11 (pybullet has no wheels beyond it); this is {sys.version.split()[0]}")
PY

log=$(mktemp)
trap 'rm -f "$log"' EXIT
step() { # say what is done, do it, and show its output only when it fails
    echo "setup: $1" >&2
    shift
    "$@" >"$log" 2>&1 || {
        cat "$log" >&2
        echo "setup: failed: $*" >&2
        exit 3
    }
}
pip_setting() { "$venv/bin/python" -m pip config list | sed -n "s/^[a-z:]*\.$1='\(.*\)'\$/\1/p" | tail -n 1; }

if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    sh "$here/debian_packages.sh" python3.11-venv
fi
if [ ! -e "$venv/.ready" ]; then # none yet, or one that was interrupted: half a package breaks pip itself
    step "1 of 3: creating $venv with $("$python" --version)" "$python" -m venv --clear "$venv"
fi
step "2 of 3: installing uv, which installs the rest ten times as fast as pip" \
    "$venv/bin/python" -m pip install --disable-pip-version-check -c "$constraints" uv
# What this computer has set for pip holds for uv, which reads variables of its own; its certificates, too.
UV_FIND_LINKS=${UV_FIND_LINKS-${PIP_FIND_LINKS-$(pip_setting find-links)}}
UV_DEFAULT_INDEX=${UV_DEFAULT_INDEX-${PIP_INDEX_URL-$(pip_setting index-url)}}
export UV_FIND_LINKS
[ -z "$UV_DEFAULT_INDEX" ] || export UV_DEFAULT_INDEX
step "3 of 3: installing $(grep -c == "$constraints") pinned packages (about 1 GB, once)" \
    "$venv/bin/uv" pip install --system-certs --python "$venv/bin/python" -c "$constraints" -e "$here/..[dev]"
