#!/bin/sh
# A wheel for arm64 with the compiled tick, made on this computer: deploy/arm64/build.sh [FOLDER=dist]
# Cross-compiles with Debian's gcc against Debian's Python 3.11 for arm64, which is fetched once (14 MB) and unpacked
# below build/arm64, without another architecture for this computer's package manager.
# Exit status 3: a tool or the network is missing; it says which.
set -eu

cd "$(dirname "$0")/../.."
out=${1:-dist}
python=${PYTHON:-.venv/bin/python}
work=$PWD/build/arm64
root=$work/root
triplet=aarch64-linux-gnu

for tool in $triplet-gcc apt-get dpkg-deb; do
    command -v "$tool" >/dev/null || {
        echo "arm64: $tool is missing: sh deploy/debian_packages.sh gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static" >&2
        exit 3
    }
done

if [ ! -f "$root/.complete" ]; then
    echo "arm64: fetching Python 3.11 for arm64" >&2
    mkdir -p "$root" "$work/apt/lists/partial" "$work/apt/archives/partial"
    : >"$work/apt/status"
    echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://deb.debian.org/debian bookworm main" \
        >"$work/apt/sources.list"
    cat >"$work/apt/apt.conf" <<END
APT::Architecture "arm64";
APT::Architectures { "arm64"; };
APT::Sandbox::User "";
Acquire::Languages "none";
Dir::State "$work/apt";
Dir::State::status "$work/apt/status";
Dir::Cache "$work/apt";
Dir::Etc::sourcelist "$work/apt/sources.list";
Dir::Etc::sourceparts "/dev/null";
END
    export APT_CONFIG="$work/apt/apt.conf"
    (cd "$work/apt/archives" && apt-get -qq update && apt-get -qq download python3.11-minimal libpython3.11-minimal \
        libpython3.11-stdlib libpython3.11-dev libc6 libgcc-s1 libstdc++6 libexpat1 zlib1g libssl3 libffi8 \
        libbz2-1.0 libsqlite3-0 liblzma5 libuuid1) >&2 || { echo "arm64: Debian's packages for arm64 cannot be fetched" >&2; exit 3; }
    for package in "$work"/apt/archives/*.deb; do dpkg-deb -x "$package" "$root"; done
    touch "$root/.complete"
fi

# setuptools takes compiler, suffix and platform from the other Python's own description of its build.
mkdir -p "$work/sysconfig"
cp "$root/usr/lib/python3.11/_sysconfigdata__$triplet.py" "$work/sysconfig/"
rm -rf build/lib.linux-aarch64-cpython-311 build/temp.linux-aarch64-cpython-311
env _PYTHON_HOST_PLATFORM=linux-aarch64 _PYTHON_SYSCONFIGDATA_NAME="_sysconfigdata__$triplet" \
    PYTHONPATH="$work/sysconfig${PYTHONPATH:+:$PYTHONPATH}" TIMBERHAND_COMPILE=1 \
    CFLAGS="-I$root/usr/include/python3.11 -I$root/usr/include" \
    "$python" -m pip --disable-pip-version-check --quiet wheel --no-deps --no-build-isolation -w "$out" .
ls "$out"/timberhand-*-linux_aarch64.whl
