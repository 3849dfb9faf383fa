"""Is this computer ready for a hard-timed loop?  Facts in, findings out, what gains most first.  Pure.

Sources: docs/how-to/real-time.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from host.doctor.facts import UNLIMITED, CanLink, Facts
from host.doctor.finding import Finding, Severity, fine

PRIORITY = 80
"""What controller and unit ask for; the guard asks for 85."""
LONG_WAKE_US = 50
"""A hundredth of the period: what an idle processor may take to come back."""
RT_SHARE = 0.9
FAST_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "timer", "hyperv_clocksource_tsc_page")
SETTINGS = "sudo nano /etc/timberhand/timberhand.conf"
LIMITS = "sudo tee -a /etc/security/limits.d/timberhand.conf  # then log in again"
TUNE = "sudo sh deploy/tune.sh --apply"


def judge(facts: Facts) -> tuple[Finding, ...]:
    """Every topic's finding, in order of gain; the CAN interfaces last."""
    found = [topic(facts) for topic in TOPICS]
    return (*(one for one in found if one is not None), *can_interfaces(facts))


def priority(facts: Facts) -> Finding:
    """FIFO for the controller: the largest single gain."""
    if facts.unit_there and (facts.unit_rtprio or 0) >= PRIORITY:
        return fine("priority", f"the service may have FIFO {facts.unit_rtprio}")
    limit = facts.rtprio_limit or 0
    if facts.may_prioritise or limit == UNLIMITED or limit >= PRIORITY:
        return fine("priority", f"this user may have FIFO {PRIORITY}")
    return Finding(
        "priority", Severity.CHANGE, f"this user may have priority {limit}; the controller asks for FIFO {PRIORITY}",
        "beside two busy processes 2 instead of 128 of 800 ticks are late",
        (f"echo \"$USER - rtprio 90\" | {LIMITS}",
         "sudo sh deploy/install.sh  # or run it as a service, whose unit grants it"),
    )  # fmt: skip


def memory(facts: Facts) -> Finding:
    """Locked memory: no page of the controller ever comes from a disk."""
    if facts.unit_there and facts.unit_memlock == UNLIMITED:
        return fine("memory", "the service may lock all its memory")
    if facts.may_lock or facts.memlock_limit == UNLIMITED:
        return fine("memory", "this user may lock all its memory")
    kb = (facts.memlock_limit or 0) // 1024
    sentence = f"this user may lock {kb} kB, too little for the controller"
    sentence += ", and there is swap space" if facts.swap else ""
    return Finding(
        "memory", Severity.CHANGE, sentence, "no tick waits for a page from the disk: one costs milliseconds",
        (f"echo \"$USER - memlock unlimited\" | {LIMITS}",),
    )  # fmt: skip


def kernel(facts: Facts) -> Finding:
    """Preemption: how long the kernel itself may hold the loop up."""
    if facts.preemption == "rt":
        return fine("kernel", f"{facts.release} is PREEMPT_RT")
    how = f"preempts '{facts.preemption}'" if facts.preemption else "does not say how it preempts"
    return Finding(
        "kernel", Severity.ADVICE if facts.machine else Severity.CHANGE, f"{facts.release} {how} and is not PREEMPT_RT",
        "the kernel's own longest delay: tens of microseconds instead of milliseconds",
        ("sudo apt-get install linux-image-rt-amd64  # then start the computer again and choose it",),
    )  # fmt: skip


def machine(facts: Facts) -> Finding:
    """Real hardware, or something that others may stop."""
    if not facts.machine:
        return fine("machine", "this is real hardware")
    return Finding(
        "machine", Severity.ADVICE, f"this is {facts.machine}: others decide when it runs",
        "figures that mean something, and a deadline that can be kept: measure on the machine's own computer",
    )  # fmt: skip


def governor(facts: Facts) -> Finding | None:
    """The clock rate must not begin low at every tick."""
    looked_at = {c: g for c, g in facts.governors.items() if facts.control_cpu in (None, c)}
    slow = sorted(c for c, g in looked_at.items() if g != "performance")
    if not looked_at:
        return None  # a virtual machine, or firmware that keeps it to itself
    if not slow:
        return fine("clock rate", "the governor is 'performance'")
    which = {looked_at[c] for c in slow}
    return Finding(
        "clock rate", Severity.CHANGE, f"the governor of processor {_list(slow)} is {_words(which)}",
        "each tick runs at full speed from its beginning, instead of some milliseconds later",
        (f"{TUNE}{_cpu(facts)}",),
    )  # fmt: skip


def control_core(facts: Facts) -> Finding:
    """A processor of its own: only when the kernel keeps everything else away from it."""
    mine = facts.control_cpu
    if mine is None:
        if len(facts.online) < 4:
            return fine("processor", f"the controller may run on any of {len(facts.online)}: too few to keep one free")
        spare = max(facts.online)
        return Finding(
            "processor", Severity.ADVICE, "no processor is kept free for the controller",
            "nothing else runs, and no interrupt is served, where the loop runs",
            (*_boot(facts, spare), f"{SETTINGS}  # CONTROLLER_OPTIONS=--cpu {spare}"),
        )  # fmt: skip
    if mine not in facts.online:
        return Finding(
            "processor", Severity.CHANGE, f"the controller is told to run on processor {mine}, which is not there",
            "it can keep to the processor that it is told", (SETTINGS,),
        )  # fmt: skip
    if mine not in facts.isolated:
        return Finding(
            "processor", Severity.CHANGE, f"the controller runs on processor {mine}, and so may everything else",
            "nothing else delays it; pinned to a shared processor it is later than free to move",
            (*_boot(facts, mine), f"{SETTINGS}  # or: CONTROLLER_OPTIONS without --cpu"),
        )  # fmt: skip
    ticking = [n for n, s in (("nohz_full", facts.tickless), ("rcu_nocbs", facts.rcu_offloaded)) if mine not in s]
    if ticking:
        return Finding(
            "processor", Severity.ADVICE, f"processor {mine} is kept free, but not by {' and '.join(ticking)}",
            "the kernel's own timer and clean-up work go elsewhere too", _boot(facts, mine),
        )  # fmt: skip
    return fine("processor", f"processor {mine} is kept free for the controller")


def sibling(facts: Facts) -> Finding | None:
    """Two threads of one core share its caches and units."""
    others = (facts.siblings & facts.online) - {facts.control_cpu}
    if facts.control_cpu is None or not others:
        return None
    if others <= facts.isolated:
        return fine("sibling", f"processor {_list(others)} of the same core is kept free too")
    return Finding(
        "sibling", Severity.ADVICE, f"processor {_list(others)} shares the core of the controller's processor",
        "the controller has the core's caches and units for itself",
        tuple(f"echo 0 | sudo tee /sys/devices/system/cpu/cpu{c}/online" for c in sorted(others)),
    )  # fmt: skip


def interrupts(facts: Facts) -> Finding | None:
    """The interrupts of the CAN adapters are served elsewhere."""
    mine = facts.control_cpu
    real = [link for link in facts.links if link.interrupts]
    if mine is None or not real:
        return None
    shared = [link for link in real if mine in link.interrupt_cpus]
    if not shared:
        return fine("interrupts", f"those of {_names(real)} are served beside processor {mine}")
    numbers = ", ".join(str(n) for link in shared for n in link.interrupts)
    return Finding(
        "interrupts", Severity.CHANGE, f"interrupt {numbers} of {_names(shared)} may be served on processor {mine}",
        "no interrupt comes between the loop and its deadline", (f"{TUNE}{_cpu(facts)}",),
    )  # fmt: skip


def balancer(facts: Facts) -> Finding | None:
    """irqbalance moves interrupts as it likes."""
    if not facts.irqbalance or facts.control_cpu is None:
        return None
    if facts.control_cpu in facts.irqbalance_banned | facts.isolated:
        return fine("irqbalance", f"it runs and leaves processor {facts.control_cpu} alone")
    return Finding(
        "irqbalance", Severity.CHANGE, f"it runs and may move interrupts to processor {facts.control_cpu} at any time",
        "interrupts stay where they were put",
        (f"echo IRQBALANCE_BANNED_CPULIST={facts.control_cpu} | sudo tee -a /etc/default/irqbalance",
         "sudo systemctl restart irqbalance"),
    )  # fmt: skip


def idle(facts: Facts) -> Finding | None:
    """How long a sleeping processor takes to come back."""
    if not facts.idle:
        return None
    deepest = max((state for state in facts.idle if not state.disabled), key=lambda s: s.latency_us, default=None)
    if deepest is None or deepest.latency_us <= LONG_WAKE_US:
        return fine("sleep", f"the deepest sleep takes {deepest.latency_us if deepest else 0} us to wake from")
    if "--dma-latency" in facts.options:
        return fine("sleep", "the controller keeps the processors out of deep sleep while it runs (--dma-latency)")
    access = "" if facts.dma_latency else "; /dev/cpu_dma_latency is not open to this user"
    return Finding(
        "sleep", Severity.ADVICE, f"waking from {deepest.name} takes {deepest.latency_us} us{access}",
        f"every tick up to {deepest.latency_us} us earlier, for more power drawn",
        (f"{SETTINGS}  # CONTROLLER_OPTIONS=--dma-latency", f"{TUNE}{_cpu(facts)}  # or so"),
    )  # fmt: skip


def delivery(facts: Facts) -> Finding | None:
    """Frames that are left to ksoftirqd wait behind every ordinary process."""
    if not facts.softirq_threads or not facts.links:
        return None
    ordinary = sorted(c for c, how in facts.softirq_threads.items() if how == "OTHER")
    if not ordinary:
        return fine("delivery", "deferred frames are delivered at real-time priority")
    return Finding(
        "delivery", Severity.ADVICE, "frames that an interrupt cannot deliver at once wait behind ordinary processes",
        "on a busy computer no frame arrives 15 ms late while the loop is on time",
        ("for pid in $(pgrep ksoftirqd); do sudo chrt --fifo --pid 60 $pid; done",),
    )  # fmt: skip


def throttling(facts: Facts) -> Finding | None:
    """The kernel stops real-time processes that run for too long; one that sleeps it never meets."""
    if facts.rt_runtime_us is None:
        return None
    if facts.rt_runtime_us == UNLIMITED:
        return Finding(
            "throttling", Severity.ADVICE, "nothing stops a real-time process that never sleeps",
            "a loop that hangs leaves the others 5 % of the time to end it",
            ("sudo sysctl -w kernel.sched_rt_runtime_us=950000",),
        )  # fmt: skip
    share = facts.rt_runtime_us / facts.rt_period_us
    if share < RT_SHARE:
        return Finding(
            "throttling", Severity.CHANGE, f"real-time processes get {share:.0%} of the time and are then stopped",
            "the loop, or one that waits awake, is never stopped in mid-tick", (f"{TUNE}{_cpu(facts)}",),
        )  # fmt: skip
    return fine("throttling", f"real-time processes get {share:.0%} of the time; a loop that sleeps never meets it")


def clock(facts: Facts) -> Finding | None:
    """Every tick reads it several times."""
    if not facts.clock_source:
        return None
    if facts.clock_source in FAST_CLOCKS:
        return fine("clock", f"{facts.clock_source} is fast to read")
    return Finding(
        "clock", Severity.CHANGE, f"the clock source is {facts.clock_source}, a device that is slow to read",
        "microseconds at every reading; the kernel's log says why it distrusts the processor's own",
        ("sudo dmesg | grep -i clocksource", "cat /sys/devices/system/clocksource/clocksource0/available_clocksource"),
    )  # fmt: skip


def pages(facts: Facts) -> Finding | None:
    """Memory that is rearranged behind the loop's back."""
    if not facts.hugepages:
        return None
    if facts.hugepages != "always":
        return fine("huge pages", f"transparent huge pages: {facts.hugepages}")
    return Finding(
        "huge pages", Severity.ADVICE, "transparent huge pages are made for every process",
        "no page of the loop is moved while it runs", (f"{TUNE}{_cpu(facts)}",),
    )  # fmt: skip


def slack(facts: Facts) -> Finding | None:
    """How late the kernel may wake an ordinary process to save power."""
    if facts.slack_ns is None:
        return None
    return fine("timer slack", f"{facts.slack_ns / 1000:.0f} us for ordinary processes; FIFO ones have none")


def can_interfaces(facts: Facts) -> Iterable[Finding]:
    """Each interface: bit rate, recovery, queue, error counters."""
    if not facts.links:
        yield Finding(
            "CAN", Severity.ADVICE, "this computer has no CAN interface", "a real bus, or a virtual one for trying",
            ("timberhand hil vcan --check  # a virtual one without one",),
        )  # fmt: skip
    for link in facts.links:
        yield _link(link)


def _link(link: CanLink) -> Finding:
    what, name = f"CAN {link.name}", link.name
    if not link.up:
        command = f"sudo ip link set {name} up" if link.virtual else f"sudo systemctl start timberhand-can@{name}"
        return Finding(what, Severity.CHANGE, "it is down", "a bus", (command,))
    if link.virtual:
        return fine(what, "virtual and up")
    troubles = {n: c for n, c in link.counters.items() if n in ("bus_off", "error_passive") and c}
    if troubles or link.state not in ("ERROR-ACTIVE", ""):
        counted = ", ".join(f"{name} {count}" for name, count in link.counters.items() if count) or "no counts"
        return Finding(
            what, Severity.CHANGE, f"{link.state or 'up'}, {link.bitrate} bit/s, with errors: {counted}",
            "frames that arrive at the first try: check cable, termination (60 ohms between the wires) and bit rate",
            (f"ip -details -statistics link show {name}", f"candump -e {name},0:0,#FFFFFFFF"),
        )  # fmt: skip
    if link.restart_ms == 0:
        return Finding(
            what, Severity.ADVICE, f"{link.bitrate} bit/s; it stays off for ever after a bus-off",
            "the bus comes back by itself after 100 ms; the controller has latched its fault by then",
            (f"sudo systemctl restart timberhand-can@{name}",),
        )  # fmt: skip
    queue = f"{link.bitrate} bit/s, restart after {link.restart_ms} ms, queue of {link.tx_queue} frames"
    return fine(what, f"{queue}, no errors")


def _boot(facts: Facts, cpu: int) -> tuple[str, ...]:
    others = _list(facts.online - {cpu})
    words = f"isolcpus=managed_irq,domain,{cpu} nohz_full={cpu} rcu_nocbs={cpu} irqaffinity={others}"
    return (f'sudo nano /etc/default/grub  # GRUB_CMDLINE_LINUX="{words}"', "sudo update-grub  # then start it again")


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
