"""Evaluates the real-time readiness of a computer: facts in, findings out, the greatest gain first.  Pure.

Sources: docs/how-to/real-time.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from host.doctor.facts import UNLIMITED, CanLink, Facts
from host.doctor.finding import Finding, Severity, fine

PRIORITY = 80
"""SCHED_FIFO priority of the controller and its unit; that of the guard is 85."""
MAX_WAKE_US = 50
"""Acceptable exit latency of an idle processor: a hundredth of the control period."""
MIN_RT_SHARE = 0.9
"""Smallest share of the time that real-time processes should get."""
SAMPLE_POINTS = (0.75, 0.9)
"""Share of the bit time at which a node may sample: CiA 301 asks for 87.5 %, SAE J1939-11 for 80 to 87.5 %."""
FAST_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "timer", "hyperv_clocksource_tsc_page")
SETTINGS = "sudo nano /etc/timberhand/timberhand.conf"
LIMITS = "sudo tee -a /etc/security/limits.d/timberhand.conf  # then log in again"
TUNE = "sudo sh deploy/tune.sh --apply"


def evaluate(facts: Facts) -> tuple[Finding, ...]:
    """The findings of all topics, in order of gain; the CAN interfaces last."""
    found = [topic(facts) for topic in TOPICS]
    return (*(one for one in found if one is not None), *can_interfaces(facts))


def priority(facts: Facts) -> Finding:
    """Real-time priority of the controller: the largest single gain."""
    if facts.unit_there and (facts.unit_rtprio or 0) >= PRIORITY:
        return fine("priority", f"the service may use FIFO {facts.unit_rtprio}")
    limit = facts.rtprio_limit or 0
    if facts.may_prioritise or limit == UNLIMITED or limit >= PRIORITY:
        return fine("priority", f"this user may use FIFO {PRIORITY}")
    return Finding(
        "priority", Severity.CHANGE, f"this user may use FIFO {limit} at most; the controller requests {PRIORITY}",
        "with two busy processes, 2 of 800 ticks are late instead of 128",
        (f"echo \"$USER - rtprio 90\" | {LIMITS}",
         "sudo sh deploy/install.sh  # or run it as a service; its unit grants the priority"),
    )  # fmt: skip


def memory(facts: Facts) -> Finding:
    """Locked memory: no page of the controller is ever read from disk."""
    if facts.unit_there and facts.unit_memlock == UNLIMITED:
        return fine("memory", "the service may lock all its memory")
    if facts.may_lock or facts.memlock_limit == UNLIMITED:
        return fine("memory", "this user may lock all its memory")
    kb = (facts.memlock_limit or 0) // 1024
    sentence = f"this user may lock {kb} kB of memory, too little for the controller"
    sentence += ", and there is swap space" if facts.swap else ""
    return Finding(
        "memory", Severity.CHANGE, sentence, "no tick waits for a page from disk, which takes milliseconds",
        (f"echo \"$USER - memlock unlimited\" | {LIMITS}",),
    )  # fmt: skip


def kernel(facts: Facts) -> Finding:
    """Preemption model: how long the kernel may delay the loop."""
    if facts.preemption == "rt":
        return fine("kernel", f"{facts.release} is PREEMPT_RT")
    how = f"uses preemption '{facts.preemption}'" if facts.preemption else "does not report its preemption model"
    return Finding(
        "kernel", Severity.ADVICE if facts.machine else Severity.CHANGE,
        f"{facts.release} {how} and is not PREEMPT_RT",
        "longest kernel delay of tens of microseconds instead of milliseconds",
        ("sudo apt-get install linux-image-rt-amd64  # then reboot and select it",),
    )  # fmt: skip


def machine(facts: Facts) -> Finding:
    """Real hardware, or a virtual machine or container."""
    if not facts.machine:
        return fine("machine", "this is real hardware")
    return Finding(
        "machine", Severity.ADVICE, f"this is {facts.machine}, which its host may interrupt",
        "meaningful measurements and reliable deadlines: use the machine's own computer",
    )  # fmt: skip


def governor(facts: Facts) -> Finding | None:
    """Frequency scaling: the clock rate must not start low at every tick."""
    looked_at = {c: g for c, g in facts.governors.items() if facts.control_cpu in (None, c)}
    slow = sorted(c for c, g in looked_at.items() if g != "performance")
    if not looked_at:
        return None  # a virtual machine, or firmware that does not expose it
    if not slow:
        return fine("clock rate", "the governor is 'performance'")
    which = {looked_at[c] for c in slow}
    return Finding(
        "clock rate", Severity.CHANGE, f"the governor of processor {_list(slow)} is {_words(which)}",
        "each tick runs at full speed from its start, not some milliseconds later",
        (f"{TUNE}{_cpu(facts)}",),
    )  # fmt: skip


def control_core(facts: Facts) -> Finding:
    """A processor for the controller alone: useful only if the kernel keeps it free of everything else."""
    mine = facts.control_cpu
    if mine is None:
        if free := facts.isolated & facts.online:
            return Finding(
                "processor", Severity.CHANGE,
                f"processor {_list(free)} is isolated, but the controller does not use it",
                "no other process and no interrupt uses the processor of the loop", _pin(max(free)),
            )  # fmt: skip
        if len(facts.online) < 4:
            return fine(
                "processor", f"the controller may use any of {len(facts.online)} processors, too few to isolate one"
            )
        spare = max(facts.online)
        return Finding(
            "processor", Severity.ADVICE, "no processor is isolated for the controller",
            "no other process and no interrupt uses the processor of the loop",
            (*_boot(facts, spare), *_pin(spare)),
        )  # fmt: skip
    if mine not in facts.online:
        return Finding(
            "processor", Severity.CHANGE, f"the settings name processor {mine}, which does not exist",
            "the controller runs on the intended processor", _unpin(facts),
        )  # fmt: skip
    if mine not in facts.isolated:
        return Finding(
            "processor", Severity.CHANGE, f"the controller runs on processor {mine}, which is not isolated",
            "nothing else delays it; pinned to a shared processor it is later than unpinned",
            (*_boot(facts, mine), *_unpin(facts, "or: ")),
        )  # fmt: skip
    ticking = [n for n, s in (("nohz_full", facts.tickless), ("rcu_nocbs", facts.rcu_offloaded)) if mine not in s]
    if ticking:
        return Finding(
            "processor", Severity.ADVICE, f"processor {mine} is isolated, but not by {' and '.join(ticking)}",
            "the kernel's timer and RCU work run on other processors", _boot(facts, mine),
        )  # fmt: skip
    return fine("processor", f"processor {mine} is isolated for the controller")


def sibling(facts: Facts) -> Finding | None:
    """Hardware threads of one core share its caches and execution units."""
    others = (facts.siblings & facts.online) - {facts.control_cpu}
    if facts.control_cpu is None or not others:
        return None
    if others <= facts.isolated:
        return fine("sibling", f"processor {_list(others)} of the same core is isolated, too")
    return Finding(
        "sibling", Severity.ADVICE, f"processor {_list(others)} shares the core of the controller's processor",
        "the controller has the caches and units of the core for itself",
        tuple(f"echo 0 | sudo tee /sys/devices/system/cpu/cpu{c}/online" for c in sorted(others)),
    )  # fmt: skip


def interrupts(facts: Facts) -> Finding | None:
    """The interrupts of the CAN adapters must run on other processors."""
    mine = facts.control_cpu
    real = [link for link in facts.links if link.interrupts]
    if mine is None or not real:
        return None
    shared = [link for link in real if mine in link.interrupt_cpus]
    if not shared:
        return fine("interrupts", f"interrupts of {_names(real)} do not use processor {mine}")
    numbers = ", ".join(str(n) for link in shared for n in link.interrupts)
    return Finding(
        "interrupts", Severity.CHANGE, f"interrupt {numbers} of {_names(shared)} may use processor {mine}",
        "no interrupt delays the loop", (f"{TUNE}{_cpu(facts)}",),
    )  # fmt: skip


def balancer(facts: Facts) -> Finding | None:
    """irqbalance may move interrupts to the processor of the controller."""
    if not facts.irqbalance or facts.control_cpu is None:
        return None
    if facts.control_cpu in facts.irqbalance_banned | facts.isolated:
        return fine("irqbalance", f"running; it does not use processor {facts.control_cpu}")
    return Finding(
        "irqbalance", Severity.CHANGE, f"running; it may move interrupts to processor {facts.control_cpu} at any time",
        "interrupts stay on their processors",
        (f"echo IRQBALANCE_BANNED_CPULIST={facts.control_cpu} | sudo tee -a /etc/default/irqbalance",
         "sudo systemctl restart irqbalance"),
    )  # fmt: skip


def idle(facts: Facts) -> Finding | None:
    """Exit latency of the idle states."""
    if not facts.idle:
        return None
    deepest = max((state for state in facts.idle if not state.disabled), key=lambda s: s.latency_us, default=None)
    if deepest is None or deepest.latency_us <= MAX_WAKE_US:
        return fine(
            "sleep", f"the deepest enabled idle state has an exit latency of {deepest.latency_us if deepest else 0} us"
        )
    if "--dma-latency" in facts.options:
        return fine("sleep", "the controller disables deep idle states while it runs (--dma-latency)")
    access = "" if facts.dma_latency else "; this user may not write /dev/cpu_dma_latency"
    return Finding(
        "sleep", Severity.ADVICE, f"idle state {deepest.name} has an exit latency of {deepest.latency_us} us{access}",
        f"every tick starts up to {deepest.latency_us} us earlier, at higher power consumption",
        (f"{SETTINGS}  # CONTROLLER_OPTIONS=--dma-latency", f"{TUNE}{_cpu(facts)}  # alternatively"),
    )  # fmt: skip


def delivery(facts: Facts) -> Finding | None:
    """Frames left to ksoftirqd wait for every ordinary process."""
    if not facts.softirq_threads or not facts.links:
        return None
    ordinary = sorted(c for c, how in facts.softirq_threads.items() if how == "OTHER")
    if not ordinary:
        return fine("delivery", "ksoftirqd delivers deferred frames at real-time priority")
    return Finding(
        "delivery", Severity.ADVICE, "ksoftirqd delivers deferred frames at ordinary priority",
        "no frame arrives 15 ms late on a busy computer",
        ("for pid in $(pgrep ksoftirqd); do sudo chrt --fifo --pid 60 $pid; done",),
    )  # fmt: skip


def throttling(facts: Facts) -> Finding | None:
    """The kernel throttles real-time processes that run for too long without sleeping."""
    if facts.rt_runtime_us is None:
        return None
    if facts.rt_runtime_us == UNLIMITED:
        return Finding(
            "throttling", Severity.ADVICE, "no throttling: nothing interrupts a real-time process that never sleeps",
            "a loop that hangs leaves 5 % of the time for ending it",
            ("sudo sysctl -w kernel.sched_rt_runtime_us=950000",),
        )  # fmt: skip
    share = facts.rt_runtime_us / facts.rt_period_us
    if share < MIN_RT_SHARE:
        return Finding(
            "throttling", Severity.CHANGE, f"real-time processes get only {share:.0%} of the time",
            "the loop is never throttled within a tick", (f"{TUNE}{_cpu(facts)}",),
        )  # fmt: skip
    return fine("throttling", f"real-time processes get {share:.0%} of the time, more than a loop that sleeps needs")


def clock(facts: Facts) -> Finding | None:
    """Clock source: every tick reads it several times."""
    if not facts.clock_source:
        return None
    if facts.clock_source in FAST_CLOCKS:
        return fine("clock", f"{facts.clock_source} is fast")
    return Finding(
        "clock", Severity.CHANGE, f"the clock source is {facts.clock_source}, which is slow to read",
        "microseconds per reading; the kernel log tells why it does not use the processor's counter",
        ("sudo dmesg | grep -i clocksource", "cat /sys/devices/system/clocksource/clocksource0/available_clocksource"),
    )  # fmt: skip


def pages(facts: Facts) -> Finding | None:
    """Transparent huge pages: the kernel moves memory while the loop runs."""
    if not facts.hugepages:
        return None
    if facts.hugepages != "always":
        return fine("huge pages", f"transparent huge pages: {facts.hugepages}")
    return Finding(
        "huge pages", Severity.ADVICE, "transparent huge pages are enabled for every process",
        "no page of the loop moves while it runs", (f"{TUNE}{_cpu(facts)}",),
    )  # fmt: skip


def slack(facts: Facts) -> Finding | None:
    """Timer slack: how late the kernel may wake an ordinary process to save power."""
    if facts.slack_ns is None:
        return None
    return fine("timer slack", f"{facts.slack_ns / 1000:.0f} us for ordinary processes, none for FIFO processes")


def can_interfaces(facts: Facts) -> Iterable[Finding]:
    """One finding per CAN interface: bit rate, recovery, queue, error counters."""
    if not facts.links:
        yield Finding(
            "CAN", Severity.ADVICE, "this computer has no CAN interface", "a real bus, or a virtual one for tests",
            ("timberhand hil vcan --check  # virtual interfaces",),
        )  # fmt: skip
    for link in facts.links:
        yield _link(link)


def _link(link: CanLink) -> Finding:
    what, name = f"CAN {link.name}", link.name
    if not link.up:
        command = f"sudo ip link set {name} up" if link.virtual else f"sudo systemctl start timberhand-can@{name}"
        return Finding(what, Severity.CHANGE, "the interface is down", "a working bus", (command,))
    if link.virtual:
        return fine(what, "virtual and up")
    troubles = {n: c for n, c in link.counters.items() if n in ("bus_off", "error_passive") and c}
    if troubles or link.state not in ("ERROR-ACTIVE", ""):
        counted = ", ".join(f"{name} {count}" for name, count in link.counters.items() if count) or "no counts"
        return Finding(
            what, Severity.CHANGE, f"{link.state or 'up'}, {link.bitrate} bit/s, with errors: {counted}",
            "frames without retransmission: check cable, termination (60 ohms between the wires) and bit rate",
            (f"ip -details -statistics link show {name}", f"candump -e {name},0:0,#FFFFFFFF"),
        )  # fmt: skip
    if link.sample_point and not SAMPLE_POINTS[0] <= link.sample_point <= SAMPLE_POINTS[1]:
        return Finding(
            what, Severity.CHANGE, f"{link.bitrate} bit/s, sampled at {100.0 * link.sample_point:.1f} % of the bit",
            "the sample point of the other nodes (CiA 301: 87.5 %): no errors from length or temperature",
            (f"sudo ip link set {name} down",
             f"sudo ip link set {name} up type can bitrate {link.bitrate} sample-point 0.875 restart-ms 100"),
        )  # fmt: skip
    if link.restart_ms == 0:
        return Finding(
            what, Severity.ADVICE, f"{link.bitrate} bit/s; no automatic restart after bus-off",
            "the bus restarts after 100 ms; the controller latches its fault before that",
            (f"sudo systemctl restart timberhand-can@{name}",),
        )  # fmt: skip
    sampled = f" sampled at {100.0 * link.sample_point:.1f} %," if link.sample_point else ""
    queue = f"{link.bitrate} bit/s,{sampled} restart after {link.restart_ms} ms, queue of {link.tx_queue} frames"
    return fine(what, f"{queue}, no errors")


def _pin(cpu: int | str, alternative: str = "") -> tuple[str, ...]:
    return (f"sudo timberhand service install --cpu {cpu}  # {alternative}the services stopped",)


def _unpin(facts: Facts, alternative: str = "") -> tuple[str, ...]:
    if "--cpu" in facts.options:
        return (f"{SETTINGS}  # {alternative}CONTROLLER_OPTIONS without --cpu",)
    return _pin("any", alternative)


def _boot(facts: Facts, cpu: int) -> tuple[str, ...]:
    others = _list(facts.online - {cpu})
    words = f"isolcpus=managed_irq,domain,{cpu} nohz_full={cpu} rcu_nocbs={cpu} irqaffinity={others}"
    return (f'sudo nano /etc/default/grub  # GRUB_CMDLINE_LINUX="{words}"', "sudo update-grub  # then reboot")


def _cpu(facts: Facts) -> str:
    return "" if facts.control_cpu is None else f" --cpu {facts.control_cpu}"


def _list(cpus: Iterable[int]) -> str:
    return ",".join(map(str, sorted(cpus)))


def _words(words: Iterable[str]) -> str:
    return " and ".join(f"'{word}'" for word in sorted(words))


def _names(links: Iterable[CanLink]) -> str:
    return ", ".join(link.name for link in links)


TOPICS: tuple[Callable[[Facts], Finding | None], ...] = (
    priority, memory, kernel, machine, governor, control_core, sibling, interrupts, balancer, idle, delivery,
    throttling, clock, pages, slack,
)  # fmt: skip
