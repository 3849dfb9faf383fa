#!/bin/sh
# Install the bundle that this lies in: sudo sh BUNDLE/install.sh --public-key signer.pem [options of deploy/install.sh]
# Needs Python 3.11 and nothing else: the wheel brings the installation, which checks signature and hashes first.
set -eu

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
python=$(command -v python3.11 || command -v python3) || {
    echo "install: Python 3.11 is missing; apt-get install python3-venv" >&2
    exit 3
}
exec "$python" "$(echo "$here"/wheels/timberhand-*.whl)/deploy" --bundle "$here" "$@"
