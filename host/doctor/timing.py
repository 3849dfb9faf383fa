"""Evaluates the real-time readiness of a computer: facts in, findings out, the greatest gain first.  Pure.

Sources: docs/how-to/real-time.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from host.doctor.facts import UNLIMITED, CanLink, Facts
from host.doctor.finding import Finding, Severity, fine, row

PRIORITY = 80
"""SCHED_FIFO priority of the controller and its unit; that of the guard is 85."""
MAX_WAKE_US = 50
"""Acceptable exit latency of an idle processor: a hundredth of the control period."""
MIN_RT_SHARE = 0.9
"""Smallest share of the time that real-time processes should get."""
SAMPLE_POINTS = (0.75, 0.9)
"""Share of the bit time at which a node may sample: CiA 301 asks for 87.5 %, SAE J1939-11 for 80 to 87.5 %."""
FAST_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "timer", "hyperv_clocksource_tsc_page")
CAN_UP = "sudo systemctl restart timberhand-can@crane0 timberhand-can@mach0  # the interfaces that the settings name"
SETTINGS = "sudo nano /etc/timberhand/timberhand.conf"
LIMITS = "sudo tee -a /etc/security/limits.d/timberhand.conf  # then log in again"
TUNE = "sudo sh deploy/tune.sh --apply"
LASTING = "sudo tuned-adm profile realtime  # instead, over restarts, too: docs/how-to/real-time.md"
ALONE = "no other process and no interrupt uses the processor of the loop"
ADVICE, CHANGE = Severity.ADVICE, Severity.CHANGE


def evaluate(facts: Facts) -> tuple[Finding, ...]:
    """Return the findings of all topics, in order of gain; the CAN interfaces last.  What is unknown has none."""
    return (*_rights(facts), *_processors(facts), *_kernel_settings(facts), *_can_interfaces(facts))


def _rights(f: Facts) -> Iterator[Finding]:
    """Check the controller's priority (the largest single gain), its memory, the kernel, the machine."""
    limit, unit = f.rtprio_limit or 0, (f.unit_rtprio or 0) if f.unit_there else 0
    granted = f"this user may use FIFO {PRIORITY}"
    granted = granted if f.may_prioritise or limit == UNLIMITED or limit >= PRIORITY else ""
    yield row(
        "priority",
        f"the service may use FIFO {unit}" if unit >= PRIORITY else granted,
        CHANGE,
        f"this user may use FIFO {limit} at most; the controller requests {PRIORITY}",
        "with two busy processes, 2 of 800 ticks are late instead of 128",
        f'echo "$USER - rtprio 90" | {LIMITS}',
        "sudo sh deploy/install.sh  # or run it as a service; its unit grants the priority",
    )
    locks = f.may_lock or f.memlock_limit == UNLIMITED
    who = "the service" if f.unit_there and f.unit_memlock == UNLIMITED else "this user" if locks else ""
    yield row(
        "memory",
        f"{who} may lock all its memory" if who else "",
        CHANGE,
        f"this user may lock {(f.memlock_limit or 0) // 1024} kB of memory, too little for the controller"
        + (", and there is swap space" if f.swap else ""),
        "no tick waits for a page from disk, which takes milliseconds",
        f'echo "$USER - memlock unlimited" | {LIMITS}',
    )
    how = f"uses preemption '{f.preemption}'" if f.preemption else "does not report its preemption model"
    yield row(
        "kernel",
        f"{f.release} is PREEMPT_RT" if f.preemption == "rt" else "",
        ADVICE if f.machine else CHANGE,
        f"{f.release} {how} and is not PREEMPT_RT",
        "longest kernel delay of tens of microseconds instead of milliseconds",
        "sudo apt-get install linux-image-rt-amd64  # then reboot and select it",
    )
    yield row(
        "machine",
        "" if f.machine else "this is real hardware",
        ADVICE,
        f"this is {f.machine}, which its host may interrupt",
        "meaningful measurements and reliable deadlines: use the machine's own computer",
        "sudo rtla osnoise top  # how long the host takes the processors away",
    )


def _processors(f: Facts) -> Iterator[Finding]:
    """Check clock rate, the controller's processor and who else uses it: its core's threads, interrupts, irqbalance."""
    control_cpu, others = f.control_cpu, (f.siblings & f.online) - {f.control_cpu}
    # No governors: the processor is virtual, or firmware hides them.
    governors = {c: g for c, g in f.governors.items() if control_cpu in (None, c)}
    slow = {c: f"'{g}'" for c, g in governors.items() if g != "performance"}
    if governors:
        yield row(
            "clock rate",
            "" if slow else "the governor is 'performance'",
            CHANGE,
            f"the governor of processor {_list(slow)} is {' and '.join(sorted(set(slow.values())))}",
            "each tick runs at full speed from its start, not some milliseconds later",
            _tune(f),
            LASTING,
        )
    yield _processor(f)
    if control_cpu is None:
        return
    if others:
        yield row(
            "sibling",
            f"processor {_list(others)} of the same core is isolated, too" if others <= f.isolated else "",
            ADVICE,
            f"processor {_list(others)} shares the core of the controller's processor",
            "the controller has the caches and units of the core for itself",
            *(f"echo 0 | sudo tee /sys/devices/system/cpu/cpu{c}/online" for c in sorted(others)),
        )
    real = [link for link in f.links if link.interrupts]
    shared = [link for link in real if control_cpu in link.interrupt_cpus]
    if real:
        numbers = ", ".join(str(n) for link in shared for n in link.interrupts)
        yield row(
            "interrupts",
            "" if shared else f"interrupts of {_names(real)} do not use processor {control_cpu}",
            CHANGE,
            f"interrupt {numbers} of {_names(shared)} may use processor {control_cpu}",
            "no interrupt delays the loop",
            _tune(f),
        )
    if f.irqbalance:
        keeps_off = control_cpu in f.irqbalance_banned | f.isolated
        yield row(
            "irqbalance",
            f"running; it does not use processor {control_cpu}" if keeps_off else "",
            CHANGE,
            f"running; it may move interrupts to processor {control_cpu} at any time",
            "interrupts stay on their processors",
            f"echo IRQBALANCE_BANNED_CPULIST={control_cpu} | sudo tee -a /etc/default/irqbalance",
            "sudo systemctl restart irqbalance",
        )


def _processor(f: Facts) -> Finding:
    """Check for a processor for the controller alone: useful only if the kernel keeps it free of everything else."""
    control_cpu, topic, free = f.control_cpu, "processor", f.isolated & f.online
    if control_cpu is None and free:
        wrong = f"processor {_list(free)} is isolated, but the controller does not use it"
        return Finding(topic, CHANGE, wrong, ALONE, (_pin(max(free)),))
    if control_cpu is None and len(f.online) < 4:
        return fine(topic, f"the controller may use any of {len(f.online)} processors, too few to isolate one")
    if control_cpu is None:
        spare = max(f.online)
        wrong = "no processor is isolated for the controller"
        return Finding(topic, ADVICE, wrong, ALONE, (*_boot(f, spare), _pin(spare)))
    if control_cpu not in f.online:
        wrong = f"the settings name processor {control_cpu}, which does not exist"
        return Finding(topic, CHANGE, wrong, "the controller runs on the intended processor", (_unpin(f),))
    if control_cpu not in f.isolated:
        wrong = f"the controller runs on processor {control_cpu}, which is not isolated"
        gain = "nothing else delays it; pinned to a shared processor it is later than unpinned"
        return Finding(topic, CHANGE, wrong, gain, (*_boot(f, control_cpu), _unpin(f, "or: ")))
    ticking = [name for name, s in (("nohz_full", f.tickless), ("rcu_nocbs", f.rcu_offloaded)) if control_cpu not in s]
    return row(
        topic,
        "" if ticking else f"processor {control_cpu} is isolated for the controller",
        ADVICE,
        f"processor {control_cpu} is isolated, but not by {' and '.join(ticking)}",
        "the kernel's timer and RCU work run on other processors",
        *_boot(f, control_cpu),
    )


def _kernel_settings(f: Facts) -> Iterator[Finding]:
    """Check idle states, delivery of frames, throttling, clock source, huge pages, task groups, timer slack."""
    if f.idle:
        deepest = max((state for state in f.idle if not state.disabled), key=lambda s: s.latency_us, default=None)
        name, us = (deepest.name, deepest.latency_us) if deepest else ("", 0)
        good = "the controller disables deep idle states while it runs (--dma-latency)"
        good = good if "--dma-latency" in f.options else ""
        access = "" if f.dma_latency else "; this user may not write /dev/cpu_dma_latency"
        yield row(
            "sleep",
            f"the deepest enabled idle state has an exit latency of {us} us" if us <= MAX_WAKE_US else good,
            ADVICE,
            f"idle state {name} has an exit latency of {us} us{access}",
            f"every tick starts up to {us} us earlier, at higher power consumption",
            f"{SETTINGS}  # CONTROLLER_OPTIONS=--dma-latency",
            f"{_tune(f)}  # alternatively",
            LASTING,
        )
    if f.softirq_threads and f.links:
        ordinary = "OTHER" in f.softirq_threads.values()
        yield row(
            "delivery",
            "" if ordinary else "ksoftirqd delivers deferred frames at real-time priority",
            ADVICE,
            "ksoftirqd delivers deferred frames at ordinary priority",
            "no frame arrives 15 ms late on a busy computer",
            "for pid in $(pgrep ksoftirqd); do sudo chrt --fifo --pid 60 $pid; done",
        )
    if f.rt_runtime_us == UNLIMITED:
        wrong = "no throttling: nothing interrupts a real-time process that never sleeps"
        gain = "a loop that hangs leaves 5 % of the time for ending it"
        yield Finding("throttling", ADVICE, wrong, gain, ("sudo sysctl -w kernel.sched_rt_runtime_us=950000",))
    elif f.rt_runtime_us is not None:
        share = f.rt_runtime_us / f.rt_period_us
        good = f"real-time processes get {share:.0%} of the time, more than a loop that sleeps needs"
        yield row(
            "throttling",
            good if share >= MIN_RT_SHARE else "",
            CHANGE,
            f"real-time processes get only {share:.0%} of the time",
            "the loop is never throttled within a tick",
            _tune(f),
        )
    if f.clock_source:
        yield row(
            "clock",
            f"{f.clock_source} is fast" if f.clock_source in FAST_CLOCKS else "",
            CHANGE,
            f"the clock source is {f.clock_source}, which is slow to read",
            "microseconds per reading; the kernel log tells why it does not use the processor's counter",
            "sudo dmesg | grep -i clocksource",
            "cat /sys/devices/system/clocksource/clocksource0/available_clocksource",
        )
    if f.hugepages:
        yield row(
            "huge pages",
            "" if f.hugepages == "always" else f"transparent huge pages: {f.hugepages}",
            ADVICE,
            "transparent huge pages are enabled for every process",
            "no page of the loop moves while it runs",
            _tune(f),
            LASTING,
        )
    if f.groups_by_session:
        yield row(
            "task groups",
            "",
            ADVICE,
            "the kernel groups ordinary processes by session, and `nice` counts only inside a session",
            "work at low priority in another terminal leaves the planner and the cameras their time",
            "sudo sysctl -w kernel.sched_autogroup_enabled=0",
        )
    if f.slack_ns is not None:
        yield fine("timer slack", f"{f.slack_ns / 1000:.0f} us for ordinary processes, none for FIFO processes")


def _can_interfaces(facts: Facts) -> Iterator[Finding]:
    """Make one finding per CAN interface: bit rate, recovery, queue, error counters."""
    if not facts.links:
        command = "timberhand hil vcan --check  # virtual interfaces"
        gain = "a real bus, or a virtual one for tests"
        yield Finding("CAN", ADVICE, "this computer has no CAN interface", gain, (command,))
    yield from map(_link, facts.links)


def _link(link: CanLink) -> Finding:
    topic, name, rate, percent = f"CAN {link.name}", link.name, f"{link.bitrate} bit/s", 100.0 * link.sample_point
    if not link.up:
        command = f"sudo ip link set {name} up" if link.virtual else CAN_UP
        return Finding(topic, CHANGE, "the interface is down", "a working bus", (command,))
    if link.virtual:
        return fine(topic, "virtual and up")
    if link.counters.get("bus_off") or link.counters.get("error_passive") or link.state not in ("ERROR-ACTIVE", ""):
        counted = ", ".join(f"{name} {count}" for name, count in link.counters.items() if count) or "no counts"
        wrong = f"{link.state or 'up'}, {rate}, with errors: {counted}"
        gain = "frames without retransmission: check cable, termination (60 ohms between the wires) and bit rate"
        commands = (f"ip -details -statistics link show {name}", f"candump -e {name},0:0,#FFFFFFFF")
        return Finding(topic, CHANGE, wrong, gain, commands)
    if link.sample_point and not SAMPLE_POINTS[0] <= link.sample_point <= SAMPLE_POINTS[1]:
        gain = "the sample point of the other nodes (CiA 301: 87.5 %): no errors from length or temperature"
        up = f"sudo ip link set {name} up type can bitrate {link.bitrate} sample-point 0.875 restart-ms 100"
        commands = (f"sudo ip link set {name} down", up)
        return Finding(topic, CHANGE, f"{rate}, sampled at {percent:.1f} % of the bit", gain, commands)
    sampled = f" sampled at {percent:.1f} %," if link.sample_point else ""
    return row(
        topic,
        f"{rate},{sampled} restart after {link.restart_ms} ms, queue of {link.tx_queue} frames, no errors"
        if link.restart_ms
        else "",
        ADVICE,
        f"{rate}; no automatic restart after bus-off",
        "the bus restarts after 100 ms; the controller latches its fault before that",
        CAN_UP,
    )


def _pin(cpu: int | str, alternative: str = "") -> str:
    return f"sudo timberhand service install --cpu {cpu}  # {alternative}the services stopped"


def _unpin(facts: Facts, alternative: str = "") -> str:
    if "--cpu" in facts.options:
        return f"{SETTINGS}  # {alternative}CONTROLLER_OPTIONS without --cpu"
    return _pin("any", alternative)


def _boot(facts: Facts, cpu: int) -> tuple[str, str]:
    others = _list(facts.online - {cpu})
    boot_options = f"isolcpus=managed_irq,domain,{cpu} nohz_full={cpu} rcu_nocbs={cpu} irqaffinity={others}"
    return f'sudo nano /etc/default/grub  # GRUB_CMDLINE_LINUX="{boot_options}"', "sudo update-grub  # then reboot"


def _tune(facts: Facts) -> str:
    return TUNE if facts.control_cpu is None else f"{TUNE} --cpu {facts.control_cpu}"


def _list(cpus: Iterable[int]) -> str:
    return ",".join(map(str, sorted(cpus)))


def _names(links: Iterable[CanLink]) -> str:
    return ", ".join(link.name for link in links)
