#!/bin/sh
# Build the vcan lab's own user-mode kernel into the user's cache; called by `make lab-kernel`.  Optional: it gives the
# lab simulated time (`timberhand hil vcan --time-travel`), ISO-TP and a faster start.
# Takes some minutes, once: the file's name holds the version of the source and a hash of lab.config, by which
# host/vcan_lab/uml.py finds it.
# Exit status: 0; 3 when packages are missing or the source does not build.
set -eu
here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
cache=${XDG_CACHE_HOME:-$HOME/.cache}/timberhand
package=linux-source-6.12 # Debian 12 has it among its security updates

say() { echo "lab-kernel: $*" >&2; }
fail() {
    say "$*"
    exit 3
}

[ "$(uname -m)" = x86_64 ] || fail "user-mode Linux runs on x86_64 only; this is $(uname -m)"
sh "$here/../debian_packages.sh" "$package" make gcc libc6-dev flex bison bc xz-utils || exit 3
version=$(dpkg-query -W -f '${Version}' "$package" | tr -c 'A-Za-z0-9.\n' _)
recipe=$(sha256sum <"$here/lab.config" | cut -c 1-12)
kernel=$cache/linux-$version-$recipe
if [ -x "$kernel" ]; then
    say "$kernel is there already"
    exit 0
fi

mkdir -p "$cache" || fail "$cache cannot be made; set XDG_CACHE_HOME"
work=$(mktemp -d "$cache/build.XXXXXX") || fail "$cache cannot be written; set XDG_CACHE_HOME"
trap 'rm -rf "$work"' EXIT
trap 'exit 130' INT TERM
say "unpacking $package $version; it needs 1 GB in $cache for a while"
# Left out: what a user-mode kernel never compiles; the Kconfig files and makefiles must stay.
tar -xf "/usr/src/$package.tar.xz" -C "$work" --strip-components=1 --wildcards \
    --exclude='*/drivers/gpu/*.[ch]' --exclude='*/drivers/media/*.[ch]' --exclude='*/drivers/staging/*.[ch]' \
    --exclude='*/drivers/net/ethernet/*.[ch]' --exclude='*/drivers/net/wireless/*.[ch]' --exclude='*/sound/*.[ch]' \
    --exclude='*/tools/testing/*' --exclude='*/tools/perf/*' --exclude='*/arch/*/boot/dts/*' --exclude='*.rst' ||
    fail "/usr/src/$package.tar.xz does not unpack; is the disk full?"
cd "$work"

# User-mode Linux keeps a process's registers in a buffer of 2696 bytes; CPUs with AMX have 11008 bytes of them, and the
# first process dies at once.  Harmless elsewhere: the CPU's own size is what is copied.
offsets=arch/x86/um/user-offsets.c
registers=$(sed -n 's/^# registers: \([0-9]*\) bytes$/\1/p' "$here/lab.config")
grep -q 'HOST_FP_SIZE, 2696' "$offsets" || fail "$offsets of $package $version is not as expected; adapt build.sh"
sed -i "s/HOST_FP_SIZE, 2696/HOST_FP_SIZE, $registers/" "$offsets"

make ARCH=um KCONFIG_ALLCONFIG="$here/lab.config" allnoconfig >"$work/log" 2>&1 ||
    fail "the configuration failed: $(tail -n 1 "$work/log")"
lost=$(grep '^CONFIG_' "$here/lab.config" | grep -vxFf .config | tr '\n' ' ') || true
[ -z "$lost" ] || fail "$package $version does not take these lines of lab.config: $lost"

jobs=$(getconf _NPROCESSORS_ONLN) # nproc heeds OMP_NUM_THREADS
say "compiling on $jobs processors"
begin=$(date +%s)
{ make ARCH=um -j"$jobs" 2>&1 || echo failed >"$work/failed"; } | tee "$work/log" | {
    files=0
    while read -r what _; do
        [ "$what" = CC ] || continue
        files=$((files + 1))
        [ $((files % 100)) -ne 0 ] || say "$files of about 700 files, $(($(date +%s) - begin)) s"
    done
}
if [ -e "$work/failed" ] || [ ! -x linux ]; then
    tail -n 20 "$work/log" >&2
    fail "the kernel does not compile; see above"
fi
strip linux
mv linux "$kernel"
say "built $kernel in $(($(date +%s) - begin)) s; try: timberhand hil vcan --time-travel -- sleep 60"
