#!/bin/sh
# Tune this computer for the control loop, as far as it can be done while it runs; `timberhand doctor --rt` says why.
# Without --apply it only prints what it would change.  What it changes lasts until the next start of the computer, or
# until --undo; running it again changes nothing more.  Boot parameters are printed, never written.
# Exit status: 0; 2 usage; 3 not permitted.
set -eu

usage() {
    cat <<'TEXT'
usage: sudo sh deploy/tune.sh [--apply | --undo] [--cpu N] [--root DIR]

  --cpu N     the processor kept for the controller: interrupts and kernel work leave it, it sleeps only lightly
  --apply     do it (default: print what would be changed)
  --undo      put back what was found before the first --apply
  --root DIR  another tree instead of /, for trying
TEXT
}

say() { echo "tune: $*" >&2; }
fail() {
    code=$1
    shift
    say "$*"
    exit "$code"
}

mode=print cpu='' root=''
while [ $# -gt 0 ]; do
    case $1 in
    --apply) mode=apply ;;
    --undo) mode=undo ;;
    --cpu | --root)
        [ $# -ge 2 ] || fail 2 "$1 needs a value; see --help"
        case $1 in
        --cpu) cpu=$2 ;;
        --root) root=${2%/} ;;
        esac
        shift
        ;;
    -h | --help)
        usage
        exit 0
        ;;
    *) fail 2 "there is no option $1; see --help" ;;
    esac
    shift
done
cpus=$root/sys/devices/system/cpu
before=$root/run/timberhand-tune # FILE VALUE, as found before the first change; gone with the next start, as the changes
case $cpu in
*[!0-9]*) fail 2 "--cpu $cpu is no number of a processor" ;;
?*) [ -d "$cpus/cpu$cpu" ] || fail 2 "there is no processor $cpu" ;;
esac
[ "$mode" = print ] || [ "$root" ] || [ "$(id -u)" -eq 0 ] || fail 3 "this needs root; start it with sudo"

# The chosen word of a file that offers several: always [madvise] never
chosen() { sed 's/.*\[\([^]]*\)\].*/\1/' "$1"; }

# Write VALUE into FILE; the kernel refuses some, as the affinity of interrupts that belong to one processor.
put() {
    if [ "$mode" = print ]; then
        echo "$1: $(chosen "$1") -> $2"
    elif { echo "$2" >"$1"; } 2>/dev/null; then
        say "$1 is now $2"
    else
        return 1
    fi
}

# change FILE VALUE: unless it is so already; notes what was there.
change() {
    [ -f "$1" ] || return 0
    was=$(chosen "$1")
    [ "$was" != "$2" ] || return 0
    put "$1" "$2" || return 0
    [ "$mode" = print ] || grep -qs "^$1 " "$before" || echo "$1 $was" >>"$before"
}

undo() {
    [ -f "$before" ] || {
        say "nothing was changed since the last start of this computer"
        exit 0
    }
    mode=apply
    while read -r file value; do put "$file" "$value" || say "$file cannot be put back to $value"; done <"$before"
    rm "$before"
    exit 0
}

# The processors but $cpu, one number each.
others() {
    tr ',' '\n' <"$cpus/online" | while IFS=- read -r first last; do seq "$first" "${last:-$first}"; done |
        grep -vx "$cpu"
}

# Numbers as the kernel writes them: 0-2,5
ranges() {
    awk '{ if (n && $1 == last + 1) last = $1; else { if (n) show(); first = last = $1 } n++ }
        END { if (n) show(); print "" }
        function show() { printf "%s%s", shown++ ? "," : "", first == last ? first : first "-" last }'
}

[ "$mode" != undo ] || undo

for governor in "$cpus"/cpu[0-9]*/cpufreq/scaling_governor; do
    case $governor in */cpu${cpu:-*}/cpufreq/*) change "$governor" performance ;; esac
done
change "$root/sys/kernel/mm/transparent_hugepage/enabled" madvise
runtime=$root/proc/sys/kernel/sched_rt_runtime_us
if [ -f "$runtime" ] && [ "$(cat "$runtime")" -ge 0 ] && [ "$(cat "$runtime")" -lt 900000 ]; then
    change "$runtime" 950000
fi
if [ "$cpu" ]; then
    rest=$(others | ranges)
    [ "$rest" ] || fail 2 "processor $cpu is the only one; nothing else can leave it"
    for state in "$cpus/cpu$cpu"/cpuidle/state[0-9]*; do
        [ -f "$state/latency" ] && [ "$(cat "$state/latency")" -gt 50 ] && change "$state/disable" 1
    done
    for irq in "$root"/proc/irq/[0-9]*/smp_affinity_list; do change "$irq" "$rest"; done
    mask=0
    for other in $(others); do if [ "$other" -lt 32 ]; then mask=$((mask | 1 << other)); else mask=-1; fi; done
    for file in "$root/proc/irq/default_smp_affinity" "$root/sys/devices/virtual/workqueue/cpumask"; do
        # A mask has a comma beyond 32 processors: left alone there, the boot parameters do it.
        [ "$mask" -lt 0 ] || [ ! -f "$file" ] || change "$file" "$(printf "%0$(($(wc -c <"$file") - 1))x" "$mask")"
    done
    if ! grep -qw "$cpu" "$cpus/isolated" 2>/dev/null; then
        say "what only the start of the kernel can do, in GRUB_CMDLINE_LINUX of /etc/default/grub, then update-grub:"
        echo "isolcpus=managed_irq,domain,$cpu nohz_full=$cpu rcu_nocbs=$cpu irqaffinity=$rest"
    fi
    if [ -z "$root" ] && pgrep -x irqbalance >/dev/null; then
        say "irqbalance runs and will move interrupts again: put IRQBALANCE_BANNED_CPULIST=$cpu into" \
            "/etc/default/irqbalance, then: systemctl restart irqbalance"
    fi
fi
if ! grep -qs 1 "$root/sys/kernel/realtime"; then
    say "this kernel is not PREEMPT_RT: apt-get install linux-image-rt-amd64, then start the computer again"
fi
