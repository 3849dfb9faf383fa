#!/bin/sh
# Replay recordings on the arm64 wheel, in emulation: deploy/arm64/replay.sh WHEEL [RECORDING...]
# Prints two lines of JSON for each recording, on the interpreter and compiled: ticks, digest of all outputs, and how many
# ticks differ from the recording; without a recording, those that are kept with the tests. Both digests must agree. A
# recording made on another processor may differ from both alike; the C library's sin, cos and atan2 are the suspects.
# Exit status 3 when a tool is missing.
set -eu

wheel=$(realpath "$1")
shift
cd "$(dirname "$0")/../.."
python=${PYTHON:-.venv/bin/python}
work=$PWD/build/arm64
root=$work/root

command -v qemu-aarch64-static >/dev/null || {
    echo "arm64: qemu-aarch64-static is missing: sh deploy/debian_packages.sh qemu-user-static" >&2
    exit 3
}
[ -f "$root/.complete" ] || { echo "arm64: no Python for arm64 yet: sh deploy/arm64/build.sh" >&2; exit 3; }

packages="python-can cantools canopen msgspec mcap packaging foxglove-sdk"
if [ "$(cat "$work/site/.complete" 2>/dev/null)" != "$packages" ]; then
    rm -rf "$work/site"
    "$python" -m pip --disable-pip-version-check --quiet install --target "$work/site" --only-binary=:all: \
        --platform manylinux2014_aarch64 --platform manylinux_2_28_aarch64 --python-version 3.11 --implementation cp \
        -c constraints.txt $packages >&2 || {
        echo "arm64: the packages for arm64 cannot be fetched" >&2
        exit 3
    }
    echo "$packages" >"$work/site/.complete"
fi
rm -rf "$work/installed"
"$python" -m zipfile -e "$wheel" "$work/installed"
if [ $# -eq 0 ]; then
    for name in palms aoro; do
        mkdir -p "$work/$name"
        xz -dc "tests/recordings/$name.mcap.xz" >"$work/$name/run.mcap"
        cp "tests/recordings/$name.toml" "$work/$name/profile.toml"
        set -- "$@" "$work/$name/run.mcap"
    done
fi
worker=$PWD/hil/tick/worker.py
for recording; do
    for switch in 0 1; do
        qemu-aarch64-static -L "$root" -E PYTHONPATH="$work/installed:$work/site" -E TIMBERHAND_COMPILED=$switch \
            "$root/usr/bin/python3.11" -P "$worker" replay "$recording"
    done
done
