#!/bin/sh
# Install timberhand as services of this computer: users, program, units, settings.  It enables the services for the
# next start and starts nothing; the machine itself is armed by a human alone.  Running it again mends.
# It travels in the wheel with all that it lays out: see __main__.py beside it.
#
# A release is a tree of its own, /opt/timberhand/releases/NAME; the link /opt/timberhand/current names the one in use.
# Whatever lies outside (units, users, udev rules) is a link through `current`, so that one rename changes all of it:
# `timberhand service update` does that in a running installation, with a check and a way back.
set -eu

usage() {
    cat <<'TEXT'
usage: sudo sh deploy/install.sh [options]
       sudo python3.11 timberhand-VERSION.whl/deploy [options]
       sudo sh BUNDLE/install.sh [options]

  --bundle DIR            install this unpacked bundle, once its signature and hashes are checked; needs no network
  --public-key FILE       the key of those who sign bundles (PEM); it is kept, and later bundles must be signed with it
  --wheel FILE            install this wheel (default: the one this comes from, or one built from this checkout)
  --find-links DIR        take every package from DIR, without a network; only the files that the lock names
  --from-environment DIR  use the packages of the virtual environment DIR instead of installing them
  --python PROGRAM        Python 3.11 or newer to run with (default: python3.11, else python3)
  --cpu N                 keep the controller on processor N, or with "any" on none (default: as it is; at the first
                          installation the last one that the kernel isolates)
  --root DIR              install into the tree DIR, or with / into an image, and touch nothing of the running system
  --tree                  only make the tree of --bundle, without its last file: part of an update
  --links                 only lay out what lies outside the release: part of an update
  --uninstall             remove what was installed; recordings, users and changed settings stay
  --dry-run               print what would be done, and do nothing
TEXT
}

say() { echo "install: $*" >&2; }
fail() {
    code=$1
    shift
    say "$*"
    exit "$code"
}

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
wheel='' links='' environment='' python='' root='' rooted='' uninstall='' dry='' bundle='' signer='' only_tree='' only_links='' cpu=''
while [ $# -gt 0 ]; do
    case $1 in
    --wheel | --find-links | --from-environment | --python | --root | --bundle | --public-key | --cpu)
        [ $# -ge 2 ] || fail 2 "$1 needs a value; see --help"
        case $1 in
        --wheel) wheel=$2 ;;
        --find-links) links=$2 ;;
        --from-environment) environment=$2 ;;
        --python) python=$2 ;;
        --root) root=${2%/} rooted=yes ;;
        --bundle) bundle=${2%/} ;;
        --public-key) signer=$2 ;;
        --cpu) cpu=$2 ;;
        esac
        shift
        ;;
    --uninstall) uninstall=yes ;;
    --tree) only_tree=yes ;;
    --links) only_links=yes ;;
    --dry-run) dry=yes ;;
    -h | --help)
        usage
        exit 0
        ;;
    *) fail 2 "there is no option $1; see --help" ;;
    esac
    shift
done

opt=/opt/timberhand # the units name it
lib=$root/usr/lib
etc=$root/etc/timberhand
conf=$etc/timberhand.conf
key=$etc/key
installed_signer=$etc/signer.pem
dropin=$root/etc/systemd/system/timberhand-.service.d/50-program.conf
pinned=$root/etc/systemd/system/timberhand-controller.service.d/50-processor.conf
processors=/sys/devices/system/cpu
command=$root/usr/local/bin/timberhand
releases=$root$opt/releases
packages=
locked=$here/lock/machine.txt # versions and hashes
case $here in "$releases"/*) mending=yes ;; *) mending='' ;; esac # started by the installed program itself

run() {
    if [ "$dry" ]; then echo "$*"; else "$@"; fi
}

# put SOURCE TARGET MODE
put() { run install -D -m "$3" "$1" "$2"; }

# through SOURCE TARGET: a link to a file of the release in use, whichever that is
through() {
    run install -d -m 0755 "${2%/*}"
    run ln -sfn "$opt/current/deploy/$1" "$2"
}

# live COMMAND...: only where this is the running system
live() { if [ -z "$rooted" ]; then run "$@"; fi; }

refuse_while_running() {
    [ -z "$rooted" ] && [ -z "$dry" ] || return 0
    for unit in "$here"/units/*.service; do
        unit=${unit##*/}
        case $unit in *@*) continue ;; esac
        if systemctl --quiet is-active "$unit" 2>/dev/null; then
            fail 5 "$unit is running; bring the crane to rest, then: systemctl stop timberhand.target"
        fi
    done
}

check() {
    [ "$dry" ] || [ "$rooted" ] || [ "$(id -u)" -eq 0 ] || fail 3 "this needs root; start it with sudo, or try --dry-run"
    [ "$rooted" ] || [ -d /run/systemd/system ] || [ "$dry" ] ||
        fail 3 "systemd does not run here; use --root / in an image or container, or --root DIR for a tree of its own"
    [ -z "$root" ] || [ -d "$root" ] || fail 2 "--root $root is no directory; make it first"
    case $cpu in
    any | '') ;;
    *[!0-9]*) fail 2 "--cpu $cpu is no number of a processor" ;;
    *) [ "$rooted" ] || [ -d "$processors/cpu$cpu" ] || fail 2 "this computer has no processor $cpu; see $processors" ;;
    esac
    # systemd reads the units before it mounts anything.
    [ "$rooted" ] || [ "$dry" ] || [ "$(stat -c %d /usr/lib)" = "$(stat -c %d /opt 2>/dev/null || stat -c %d /)" ] ||
        fail 3 "/opt lies on another file system than /usr; the units in it would be missing at the start"
}

# The signature of the list of hashes, by the key that is installed or named; then every file by the list.
check_bundle() {
    [ "$bundle" ] || return 0
    [ -f "$bundle/SHA256SUMS" ] || fail 2 "--bundle $bundle holds no SHA256SUMS; unpack the bundle and name its folder"
    [ -z "$wheel$links$environment" ] || fail 2 "--bundle brings its own packages; leave out the other sources"
    if [ "$only_tree" ]; then # checked by the release in use
        wheel=$(echo "$bundle"/wheels/timberhand-*.whl)
        return 0
    fi
    command -v openssl >/dev/null || fail 3 "openssl is missing, which checks the signature; apt-get install openssl"
    if [ -z "$signer" ]; then signer=$installed_signer; fi
    [ -f "$signer" ] || fail 3 "no key to check the bundle with; name that of its maker with --public-key FILE"
    [ ! -f "$installed_signer" ] || cmp -s "$signer" "$installed_signer" ||
        fail 3 "$signer is not the key that is installed as $installed_signer; bundles are checked with that one"
    openssl pkeyutl -verify -pubin -inkey "$signer" -rawin -in "$bundle/SHA256SUMS" \
        -sigfile "$bundle/SHA256SUMS.sig" >/dev/null 2>&1 ||
        fail 3 "the signature of $bundle is not by $signer; nothing is installed: get the bundle again from its maker"
    (cd "$bundle" && sha256sum --check --strict --status SHA256SUMS 2>/dev/null) ||
        fail 3 "a file in $bundle is missing or not the one that was signed; nothing is installed: get the bundle again"
    wheel=$(echo "$bundle"/wheels/timberhand-*.whl)
}

check_program() {
    [ -z "$wheel" ] || [ -f "$wheel" ] || fail 2 "--wheel $wheel is no file"
    [ "$wheel" ] || [ "$mending" ] || [ -f "$here/../pyproject.toml" ] ||
        fail 2 "there is no checkout around $here to build a wheel from; name a wheel with --wheel FILE"
    [ -z "$links" ] || [ -d "$links" ] || fail 2 "--find-links $links is no directory"
    if [ -z "$python" ]; then python=$(command -v python3.11 || command -v python3 || true); fi
    [ "$python" ] || fail 3 "there is no Python; apt-get install python3.11, or name one with --python"
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail 3 "$python is older than Python 3.11; name another one with --python"
    for compiled in "$bundle"/wheels/numpy-*-cp3*.whl; do # a bundle's compiled packages are for one Python
        [ -f "$compiled" ] || continue
        wanted=${compiled##*/numpy-*-cp}
        wanted=3.${wanted#3}
        wanted=${wanted%%-*}
        "$python" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$wanted')" ||
            fail 3 "the bundle is for Python $wanted, and $python is another one; name it with --python (Debian 12 has it)"
    done
    case ${rooted:+$opt}$("$python" -c 'import os, sys; print(os.path.realpath(sys.executable))') in
    /home/* | /root/*)
        fail 3 "$python lies in a home directory, which the services may not see; name another one with --python"
        ;;
    esac
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        fail 3 "$python cannot make virtual environments; apt-get install python3-venv"
    if [ "$environment" ]; then
        for packages in "$(realpath "$environment")"/lib/python3*/site-packages ''; do [ ! -d "$packages" ] || break; done
        [ "$packages" ] || fail 2 "--from-environment $environment holds no Python packages"
    fi
}

pip() { run "$tree/bin/python" -m pip --disable-pip-version-check --quiet "$@"; }

# A release is called after its version and its wheel.
name_release() {
    if [ "$mending" ]; then
        name=${here#"$releases"/}
        name=${name%%/*}
    elif [ -f "$wheel" ]; then
        name=$(basename "$wheel")
        name=${name#timberhand-}
        name=${name%%-*}-$(sha256sum "$wheel" | cut -c 1-12)
    else
        name=VERSION-HASH # of a wheel that is still to be built
    fi
    tree=$releases/$name
}

build_wheel() {
    [ -z "$wheel$mending" ] || return 0
    say "building a wheel from $(dirname "$here")"
    work=$(mktemp -d)
    trap 'rm -rf "$work"' EXIT
    run sh -c "cd '$here/..' && tar -cf - --exclude=./.[!.]* --exclude=./runs --exclude=__pycache__ . | tar -xf - -C '$work'"
    run "$python" -m venv "$work/venv"
    run "$work/venv/bin/python" -m pip --disable-pip-version-check --quiet wheel \
        ${links:+--no-index --find-links "$links"} --no-deps --wheel-dir "$work/wheel" "$work"
    if [ -z "$dry" ]; then wheel=$(echo "$work"/wheel/timberhand-*.whl); fi
}

install_program() {
    build_wheel
    name_release
    if ! "$tree/bin/python" -c 'import pip' 2>/dev/null; then # none yet, or one that was interrupted
        say "creating $tree with $("$python" --version)"
        run "$python" -m venv --clear "$tree"
    fi
    lib_python=lib/python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    site=$tree/$lib_python/site-packages
    [ "$mending" ] || run rm -f "$site/timberhand-environment.pth"
    if [ "$packages" ]; then run sh -c "echo '$packages' > '$site/timberhand-environment.pth'"; fi
    if [ "$bundle" ]; then
        say "installing the bundle $name"
        pip install --no-index --no-deps --require-hashes --find-links "$bundle/wheels" --force-reinstall \
            --requirement "$bundle/requirements.txt"
        # An installation that takes its packages from an environment goes on doing so.
        given=$root$opt/current/$lib_python/site-packages/timberhand-environment.pth
        [ ! -f "$given" ] || run cp "$given" "$site/"
    else
        if [ "$wheel" ]; then
            say "installing $(basename "$wheel") and what it needs"
            pip install --no-deps --force-reinstall --no-index "$wheel"
        fi
        if [ "$mending" ] && [ -f "$tree/SHA256SUMS" ]; then # a bundle was complete
            :
        elif [ "$packages" ] || [ -f "$site/timberhand-environment.pth" ]; then # taken as they are, but none may lack
            pip install --no-index ${links:+--find-links "$links"} 'timberhand[autonomy,console,plc,update]'
        else
            pip install ${links:+--no-index --find-links "$links"} --no-deps --require-hashes --requirement "$locked"
        fi
    fi
    if [ "$root" ]; then # the programs will be called in the tree's own root
        run find "$tree/bin" -type f -exec sed -i "1s|^#!$tree/bin|#!$opt/releases/$name/bin|" {} +
    fi
    run ln -sfn "$lib_python/site-packages/deploy" "$tree/deploy"
    finish_release
}

# Its last file says that a release is whole; what is not whole an update removes.
finish_release() {
    if [ "$bundle" ]; then
        for file in SHA256SUMS SHA256SUMS.sig program.sha256; do put "$bundle/$file" "$tree/$file" 0644; done
        run sync
        [ "$only_tree" ] || put "$bundle/release.json" "$tree/release.json" 0644
    elif [ ! -f "$tree/release.json" ]; then # unsigned
        run sync
        run sh -c "printf '{\"name\": \"%s\", \"version\": \"%s\"}\n' '$name' '${name%-*}' > '$tree/release.json'"
    fi
    run sync
}

# One rename changes from the former release to this one.
use_release() {
    former=$(readlink "$root$opt/current" || true)
    [ "$former" != "releases/$name" ] || return 0
    if [ "$former" ]; then run ln -sfn "$former" "$root$opt/previous"; fi
    run ln -sfn "releases/$name" "$root$opt/current.new"
    run mv -T "$root$opt/current.new" "$root$opt/current"
    run sync
}

# Settings are this computer's own; what a release adds to them is as it ships it, until `timberhand config migrate`.
install_conf() {
    if [ ! -e "$conf" ]; then
        put "$here/timberhand.conf" "$conf" 0644
    elif ! cmp -s "$here/timberhand.conf" "$conf"; then
        say "$conf was changed here and stays as it is"
    fi
}

# Secret bytes of this installation alone.  The services get them as a credential; a person's commands need them too.
make_key() {
    if [ ! -s "$key" ]; then
        run sh -c "umask 077 && head -c 32 /dev/urandom | base64 -w 0 > '$key.new' && mv '$key.new' '$key'"
    fi
    if [ -z "$root" ]; then run chown root:timberhand-operator "$key"; fi
    run chmod 0440 "$key"
}

# Programs and libraries outside /usr and /opt, from where the units let nothing else run.
allow_program() {
    [ -z "$mending" ] || [ "$packages" ] || return 0 # as it is
    places=
    [ ! "$packages" ] || places=$packages
    real=$("$python" -c 'import os, sys; print(os.path.realpath(sys.base_prefix))')
    case $real in /usr | /usr/* | /opt/*) ;; *) places="$places $real" ;; esac
    if [ "$places" ]; then
        run install -d -m 0755 "${dropin%/*}"
        run sh -c "printf '[Service]\nExecPaths=%s\n' '$places' > '$dropin'"
    else
        run rm -f "$dropin"
    fi
}

# The processor of the controller: as named; else as it is; else, the first time, the last one that the kernel isolates.
pin() {
    if [ -z "$cpu" ]; then
        [ -z "$rooted" ] && [ ! -e "$conf" ] || return 0
        read -r isolated <"$processors/isolated" && [ "$isolated" ] || return 0
        cpu=${isolated##*[-,]}
        say "the controller gets processor $cpu, which the kernel isolates; another one: --cpu N"
    fi
    if [ "$cpu" = any ]; then
        run rm -f "$pinned"
    else
        run install -d -m 0755 "${pinned%/*}"
        run sh -c "printf '[Service]\nCPUAffinity=%s\n' '$cpu' > '$pinned'"
    fi
}

units() { for unit in "$here"/units/*; do echo "${unit##*/}"; done; }
enabled() { units | grep -v -e @ -e '\.slice$'; }

# What lies outside the release, and names it only through `current`.
link_all() {
    through system/sysusers.conf "$lib/sysusers.d/timberhand.conf"
    through system/sysctl.conf "$lib/sysctl.d/60-timberhand.conf"
    through system/modules.conf "$lib/modules-load.d/timberhand.conf"
    through system/udev.rules "$lib/udev/rules.d/60-timberhand.rules"
    through system/timberhand.catalog "$lib/systemd/catalog/timberhand.catalog"
    for unit in $(units); do
        # An update enables what is new; what somebody disabled stays so.  By the links alone: the file comes later.
        if [ "$only_links" ] && [ ! -e "$root$opt/current/deploy/units/$unit" ] && enabled | grep -qxF "$unit"; then
            run install -d -m 0755 "$root/etc/systemd/system/timberhand.target.wants"
            run ln -sfn "/usr/lib/systemd/system/$unit" "$root/etc/systemd/system/timberhand.target.wants/$unit"
        fi
        through "units/$unit" "$lib/systemd/system/$unit"
    done
    if [ ! -e "$command" ] || [ -L "$command" ]; then
        run install -d -m 0755 "${command%/*}"
        run ln -sfn "$opt/current/bin/timberhand" "$command"
    fi
    if [ -z "$root" ]; then run systemd-sysusers "$here/system/sysusers.conf"; fi
}

install_all() {
    check_bundle
    check_program
    refuse_while_running
    install_program
    use_release
    link_all
    pin
    install_conf
    make_key
    if [ "$signer" ] && [ ! -f "$installed_signer" ]; then put "$signer" "$installed_signer" 0644; fi
    allow_program
    # A kernel without these says so when a bus is opened.
    live /lib/systemd/systemd-modules-load "$lib/modules-load.d/timberhand.conf" || true
    live /lib/systemd/systemd-sysctl "$lib/sysctl.d/60-timberhand.conf"
    if [ "$dry" ] || command -v udevadm >/dev/null; then # else an adapter is not set up again, and no --dma-latency
        live udevadm control --reload
        live udevadm trigger --sysname-match=cpu_dma_latency
    fi
    live systemctl daemon-reload
    live journalctl --update-catalog || true # without a journal the texts are of no use
    # shellcheck disable=SC2046 # a list of words
    run systemctl --quiet ${rooted:+--root="${root:-/}"} enable $(enabled)
    say "installed; enabled for the next start of the computer; nothing runs yet and nothing is armed"
    say "look at $conf, then: systemctl start timberhand.target"
}

uninstall_all() {
    live systemctl --quiet stop timberhand.target 2>/dev/null || true
    # shellcheck disable=SC2046 # a list of words
    run systemctl --quiet ${rooted:+--root="${root:-/}"} disable $(enabled) 2>/dev/null || true
    for folder in systemd/system sysusers.d sysctl.d modules-load.d udev/rules.d systemd/catalog; do
        [ ! -d "$lib/$folder" ] || run find "$lib/$folder" -maxdepth 1 -lname "$opt/current/*" -delete
    done
    live systemctl daemon-reload
    if [ -e "$conf" ] && cmp -s "$conf" "$here/timberhand.conf"; then
        run rm -f "$conf"
    fi
    run rm -rf "$root$opt"
    live journalctl --update-catalog || true
    run rm -f "$dropin" "$pinned" "$installed_signer"
    # Recordings of earlier releases hold datagrams that only this key reads.
    [ -d "$root/var/lib/timberhand" ] || run rm -f "$key"
    for folder in "${dropin%/*}" "${pinned%/*}"; do
        [ ! -d "$folder" ] || run rmdir --ignore-fail-on-non-empty "$folder"
    done
    if [ "$(readlink "$command")" = "$opt/current/bin/timberhand" ]; then run rm -f "$command"; fi
    [ ! -d "$etc" ] || run rmdir --ignore-fail-on-non-empty "$etc"
    say "removed"
    if [ -e "$conf" ] && [ -z "$dry" ]; then say "$conf was changed here and stays"; fi
    if [ -d "$root/var/lib/timberhand" ]; then say "the recordings in $root/var/lib/timberhand stay, with their user and $key"; fi
}

umask 022
check
if [ "$uninstall" ]; then
    uninstall_all
elif [ "$only_tree" ]; then
    check_bundle
    check_program
    install_program
elif [ "$only_links" ]; then
    link_all
else
    install_all
fi
