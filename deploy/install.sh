#!/bin/sh
# Install timberhand as services of this computer: users, program, units, settings.  It enables the services for the
# next start and starts nothing; the machine itself is armed by a human alone.  Running it again mends and updates.
# It travels in the wheel with all that it lays out: see __main__.py beside it.
set -eu

usage() {
    cat <<'TEXT'
usage: sudo sh deploy/install.sh [options]
       sudo python3.11 timberhand-VERSION.whl/deploy [options]

  --wheel FILE            install this wheel (default: the one this comes from, or one built from this checkout)
  --find-links DIR        take every package from DIR, without a network
  --from-environment DIR  use the packages of the virtual environment DIR instead of installing them
  --python PROGRAM        Python 3.11 or newer to run with (default: python3.11, else python3)
  --root DIR              install into the tree DIR and touch nothing of the running system
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
wheel='' links='' environment='' python='' root='' uninstall='' dry=''
while [ $# -gt 0 ]; do
    case $1 in
    --wheel | --find-links | --from-environment | --python | --root)
        [ $# -ge 2 ] || fail 2 "$1 needs a value; see --help"
        case $1 in
        --wheel) wheel=$2 ;;
        --find-links) links=$2 ;;
        --from-environment) environment=$2 ;;
        --python) python=$2 ;;
        --root) root=${2%/} ;;
        esac
        shift
        ;;
    --uninstall) uninstall=yes ;;
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
shipped=$lib/timberhand/timberhand.conf
venv=$root$opt
link=$root/usr/local/bin/timberhand
packages=
constraints=$here/constraints.txt
case $here in "$venv"/*) mending=yes ;; *) mending='' ;; esac # started by the installed program itself

run() {
    if [ "$dry" ]; then echo "$*"; else "$@"; fi
}

# put SOURCE TARGET MODE
put() { run install -D -m "$3" "$1" "$2"; }

# live COMMAND...: only where this is the running system
live() { if [ -z "$root" ]; then run "$@"; fi; }

refuse_while_running() {
    [ -z "$root" ] && [ -z "$dry" ] || return 0
    for unit in "$here"/units/*.service; do
        unit=${unit##*/}
        case $unit in *@*) continue ;; esac
        if systemctl --quiet is-active "$unit" 2>/dev/null; then
            fail 5 "$unit is running; bring the crane to rest, then: systemctl stop timberhand.target"
        fi
    done
}

check() {
    [ "$dry" ] || [ "$root" ] || [ "$(id -u)" -eq 0 ] || fail 3 "this needs root; start it with sudo, or try --dry-run"
    [ "$root" ] || [ -d /run/systemd/system ] || [ "$dry" ] ||
        fail 3 "systemd does not run here; with --root DIR the files are laid out in a tree of their own"
    [ -z "$root" ] || [ -d "$root" ] || fail 2 "--root $root is no directory; make it first"
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
    case ${root:+$opt}$("$python" -c 'import os, sys; print(os.path.realpath(sys.executable))') in
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

pip() { run "$venv/bin/python" -m pip --disable-pip-version-check --quiet "$@"; }

install_program() {
    if ! "$venv/bin/python" -c 'import pip' 2>/dev/null; then # none yet, or one that was interrupted
        say "creating $venv with $("$python" --version)"
        run "$python" -m venv --clear "$venv"
    fi
    site=$venv/lib/python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')/site-packages
    [ "$mending" ] || run rm -f "$site/timberhand-environment.pth"
    if [ "$packages" ]; then run sh -c "echo '$packages' > '$site/timberhand-environment.pth'"; fi
    if [ -z "$wheel$mending" ]; then
        say "building a wheel from $(dirname "$here")"
        work=$(mktemp -d)
        trap 'rm -rf "$work"' EXIT
        run sh -c "cd '$here/..' && tar -cf - --exclude=./.[!.]* --exclude=./runs --exclude=__pycache__ . | tar -xf - -C '$work'"
        pip wheel ${links:+--no-index --find-links "$links"} --no-deps --wheel-dir "$work/wheel" "$work"
        wheel=$(echo "$work"/wheel/timberhand-*.whl)
    fi
    if [ "$wheel" ]; then
        say "installing $(basename "$wheel") and what it needs"
        pip install --no-deps --force-reinstall --no-index "$wheel"
    fi
    if [ "$environment" ] && [ -z "$links" ]; then offline=yes; else offline=$links; fi
    pip install ${offline:+--no-index} ${links:+--find-links "$links"} --constraint "$constraints" \
        'timberhand[autonomy,console,plc]'
    if [ "$root" ]; then # the programs will be called in the tree's own root
        run find "$venv/bin" -type f -exec sed -i "1s|^#!$venv/bin|#!$opt/bin|" {} +
    fi
}

install_conf() {
    if [ -e "$conf" ] && ! cmp -s "$conf" "$shipped"; then
        if cmp -s "$here/timberhand.conf" "$shipped"; then
            say "$conf was changed here and stays as it is"
        else
            put "$here/timberhand.conf" "$conf.new" 0644
            say "$conf was changed here and stays as it is; the new version lies beside it as timberhand.conf.new"
        fi
    else
        put "$here/timberhand.conf" "$conf" 0644
    fi
    put "$here/timberhand.conf" "$shipped" 0644
}

units() { for unit in "$here"/units/*; do echo "${unit##*/}"; done; }
enabled() { units | grep -v @; }

install_all() {
    check_program
    refuse_while_running
    put "$here/system/sysusers.conf" "$lib/sysusers.d/timberhand.conf" 0644
    put "$here/system/sysctl.conf" "$lib/sysctl.d/60-timberhand.conf" 0644
    put "$here/system/modules.conf" "$lib/modules-load.d/timberhand.conf" 0644
    put "$here/system/udev.rules" "$lib/udev/rules.d/60-timberhand.rules" 0644
    put "$here/system/can-up" "$lib/timberhand/can-up" 0755
    put "$here/system/timberhand.catalog" "$lib/systemd/catalog/timberhand.catalog" 0644
    install_program
    if [ ! -e "$link" ] || [ "$(readlink "$link")" = "$opt/bin/timberhand" ]; then
        run install -d -m 0755 "${link%/*}"
        run ln -sfn "$opt/bin/timberhand" "$link"
    fi
    install_conf
    for unit in $(units); do put "$here/units/$unit" "$lib/systemd/system/$unit" 0644; done
    live systemd-sysusers timberhand.conf
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
    run systemctl --quiet ${root:+--root="$root"} enable $(enabled)
    say "installed; enabled for the next start of the computer; nothing runs yet and nothing is armed"
    say "look at $conf, then: systemctl start timberhand.target"
}

uninstall_all() {
    live systemctl --quiet stop timberhand.target 2>/dev/null || true
    # shellcheck disable=SC2046 # a list of words
    run systemctl --quiet ${root:+--root="$root"} disable $(enabled) 2>/dev/null || true
    for unit in $(units); do run rm -f "$lib/systemd/system/$unit"; done
    live systemctl daemon-reload
    if [ -e "$conf" ] && cmp -s "$conf" "$shipped"; then
        run rm -f "$conf"
    fi
    run rm -rf "$lib/timberhand" "$lib/sysusers.d/timberhand.conf" "$lib/sysctl.d/60-timberhand.conf" \
        "$lib/modules-load.d/timberhand.conf" "$lib/udev/rules.d/60-timberhand.rules" \
        "$lib/systemd/catalog/timberhand.catalog" "$venv"
    live journalctl --update-catalog || true
    run rm -f "$conf.new"
    if [ "$(readlink "$link")" = "$opt/bin/timberhand" ]; then run rm -f "$link"; fi
    [ ! -d "$etc" ] || run rmdir --ignore-fail-on-non-empty "$etc"
    say "removed"
    if [ -e "$conf" ] && [ -z "$dry" ]; then say "$conf was changed here and stays"; fi
    if [ -d "$root/var/lib/timberhand" ]; then say "the recordings in $root/var/lib/timberhand stay, with their user"; fi
}

umask 022
check
if [ "$uninstall" ]; then uninstall_all; else install_all; fi
