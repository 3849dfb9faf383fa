#!/bin/sh
# Create the virtual environment $1 from constraints.txt.  Called by `make setup`.
# Installs Debian's python3-venv where the interpreter cannot make an environment by itself and we may install it.
set -eu
venv=$1
python=${PYTHON:-python3.11}
here=$(dirname "$0")

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

if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    sh "$here/debian_packages.sh" python3.11-venv
fi
if [ ! -e "$venv/.ready" ]; then # none yet, or one that was interrupted: half a package breaks pip itself
    echo "setup: creating $venv with $("$python" --version)" >&2
    "$python" -m venv --clear "$venv"
fi
echo "setup: installing the pinned packages (about 1 GB, once)" >&2
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -c "$here/../constraints.txt" -e "$here/..[dev]"
