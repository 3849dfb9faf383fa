#!/bin/sh
# Install Debian packages: the ones named as arguments, else those that the tests and tools can use.
# Installs as root or by passwordless sudo; else says what is missing and how to get it.
# Exit status: 0; 3 when a package named as argument is still missing (the default ones are optional: what
# needs them says so when it runs).
set -eu

# user-mode-linux, gcc, libc6-dev: the vcan lab where the kernel has no CAN; can-utils, iproute2: looking at
# buses; rt-tests: cyclictest, to which the timing figures are compared; systemd, udev, python3-venv: the service lab;
# qemu-system-x86, cpio: the real-time lab; mbpoll, libmodbus5: Modbus clients that are not ours; chromium: looking at
# the console's page.
# For the arm64 wheel: gcc-aarch64-linux-gnu, libc6-dev-arm64-cross, qemu-user-static. For the scripts: shellcheck.
# valgrind: counting what a tick executes and touches. mmdebstrap: a Debian of its own to install into.
wanted=${*:-user-mode-linux gcc libc6-dev can-utils iproute2 rt-tests stress-ng strace systemd udev python3-venv qemu-system-x86 cpio mbpoll libmodbus5 chromium gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static shellcheck valgrind mmdebstrap}

if ! command -v apt-get >/dev/null; then
    echo "packages: no apt-get here; these Debian packages are used if present: $wanted" >&2
    [ $# -eq 0 ] || exit 3
    exit 0
fi

missing() {
    for package in $wanted; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q '^install ok installed$' || printf '%s ' "$package"
    done
}

todo=$(missing)
[ -n "$todo" ] || exit 0

as_root=
if [ "$(id -u)" -ne 0 ]; then
    if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then as_root="sudo -n"; else as_root=no; fi
fi
if [ "$as_root" != no ]; then
    echo "packages: installing $todo" >&2
    $as_root apt-get update -qq >&2 || true
    for package in $todo; do # one by one: a package this architecture lacks must not stop the others
        $as_root env DEBIAN_FRONTEND=noninteractive \
            apt-get install -y -qq --no-install-recommends "$package" >/dev/null || true
    done
fi

todo=$(missing)
[ -n "$todo" ] || exit 0
echo "packages: missing: $todo- install with: sudo apt-get install $todo" >&2
[ $# -eq 0 ] || exit 3
