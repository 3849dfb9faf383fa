#!/bin/sh
# Lock what an installation fetches: deploy/lock.sh [PYTHON=.venv/bin/python]
# Writes deploy/lock/machine.txt, what a machine's computer needs, and deploy/lock/plant.txt, the same with the physics plant:
# the versions of constraints.txt, with the SHA-256 of every wheel that the package index has of them, for amd64 and arm64 and
# for every Python that the program accepts.  pip then takes no other file (--require-hashes), whoever serves it.
# Run it after a change of constraints.txt or of the dependencies in pyproject.toml; tests/deploy/test_lock.py tells when.
# Exit status: 3 uv or the network is missing.
set -eu

cd "$(dirname "$0")/.."
python=${1:-.venv/bin/python}
"$python" -c 'import uv' 2>/dev/null || {
    echo "lock: uv is missing: pip install 'timberhand[audit]'" >&2
    exit 3
}

# lock NAME EXTRA...
lock() {
    file=deploy/lock/$1.txt
    shift
    fresh=$(mktemp)
    # shellcheck disable=SC2046 # a list of words
    "$python" -m uv pip compile --quiet --no-cache --system-certs --universal --generate-hashes --only-binary :all: \
        --no-annotate --no-header --python-version 3.11 --constraint constraints.txt \
        $(printf ' --extra %s' "$@") --output-file "$fresh" pyproject.toml >/dev/null || {
        rm -f "$fresh"
        echo "lock: $file stays as it was: uv's reason is above" >&2
        exit 3
    }
    { echo "# Made by deploy/lock.sh (make lock); not to be edited."; cat "$fresh"; } >"$file"
    rm -f "$fresh"
    echo "$file"
}

mkdir -p deploy/lock
lock machine autonomy console plc update
lock plant autonomy console plc update sim
