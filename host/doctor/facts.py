"""The facts of a Linux computer that matter to a real-time loop, read once from /proc, /sys and ip(8).

``read(root, links)`` reads below any root, for example a test tree.  A fact that is missing or unreadable is unknown
(None, empty), never an error: old kernels and containers offer less.  `read_computer` adds what a report
states; nothing in it names a person, a host or a disk: of the kernel's command line only `BOOT_WORDS` are kept.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

BOOT_WORDS: Final = re.compile(
    "isolcpus|nohz_full|rcu_nocbs|irqaffinity|preempt|threadirqs|idle|processor.max_cstate|intel_idle.max_cstate|"
    "intel_pstate|amd_pstate|clocksource|tsc|skew_tick|nosoftlockup|nmi_watchdog|mitigations|maxcpus|nosmt|mce"
)
"""Words of the kernel's command line that change its timing (admin-guide/kernel-parameters)."""
UNLIMITED: Final = -1
"""A limit of "unlimited"."""
_POLICIES: Final = {0: "OTHER", 1: "FIFO", 2: "RR"}
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_UNIT: Final = "timberhand-controller.service"
_UNIT_FOLDERS: Final = ("etc/systemd/system", "usr/lib/systemd/system")
_CONF: Final = "etc/timberhand/timberhand.conf"
_PROCESSOR: Final = f"etc/systemd/system/{_UNIT}.d/50-processor.conf"
"""What ``timberhand service install --cpu N`` writes."""


@dataclass(frozen=True, slots=True)
class IdleState:
    """An idle state of a processor, with its exit latency."""

    name: str
    latency_us: int
    disabled: bool


@dataclass(frozen=True, slots=True)
class CanLink:
    """A CAN interface; a virtual one has no bit rate, error counters or interrupts.

    ``counters``: restarts, bus_error, error_warning, error_passive, bus_off, tx and rx (error counters).
    """

    name: str
    virtual: bool
    up: bool
    state: str
    bitrate: int
    sample_point: float
    """Share of the bit time, 0 where the driver does not tell."""
    restart_ms: int
    tx_queue: int
    counters: dict[str, int]
    interrupts: tuple[int, ...]
    interrupt_cpus: frozenset[int]


@dataclass(frozen=True, slots=True)
class Facts:
    """The facts of one computer.

    ``control_cpu``: processor of the controller, None for any; ``siblings`` and ``idle`` belong to that processor, or
    to the first one.  ``options``: CONTROLLER_OPTIONS of the settings.  ``may_prioritise``, ``may_lock``: this process
    has the capability, whatever the limits.
    """

    release: str
    preemption: str
    machine: str
    online: frozenset[int]
    control_cpu: int | None
    siblings: frozenset[int]
    isolated: frozenset[int]
    tickless: frozenset[int]
    rcu_offloaded: frozenset[int]
    governors: dict[int, str]
    idle: tuple[IdleState, ...]
    dma_latency: bool
    clock_source: str
    rt_runtime_us: int | None
    rt_period_us: int
    rtprio_limit: int | None
    memlock_limit: int | None
    unit_rtprio: int | None
    unit_memlock: int | None
    unit_there: bool
    may_prioritise: bool
    may_lock: bool
    options: str
    swap: bool
    hugepages: str
    groups_by_session: bool
    irqbalance: bool
    irqbalance_banned: frozenset[int]
    softirq_threads: dict[int, str]
    slack_ns: int | None
    links: tuple[CanLink, ...]


@dataclass(frozen=True, slots=True)
class Computer:
    """What a report states beyond `Facts`.

    ``interrupts``: numbers of the interrupts that may use the controller's processor, of ``interrupts_all`` in all.
    ``new_interrupts``: processors that an interrupt uses by default."""

    processor: str
    processors: int
    memory_mb: int
    kernel_version: str
    boot_words: tuple[str, ...]
    interrupts: tuple[int, ...]
    interrupts_all: int
    new_interrupts: str


def read(root: Path, links: str = "[]", control_cpu: int | None = None) -> Facts:
    """Read the facts below ``root``; ``links`` is the output of ``ip -details -statistics -json link``."""
    cmdline = _text(root / "proc/cmdline")
    cpus = root / "sys/devices/system/cpu"
    unit = next((text for folder in _UNIT_FOLDERS if (text := _text(root / folder / _UNIT))), "")
    options = _setting(_text(root / _CONF), "CONTROLLER_OPTIONS")
    if control_cpu is None and (match := re.search(r"--cpu[ =](\d+)", options)):
        control_cpu = int(match[1])
    if control_cpu is None:
        control_cpu = _number(_setting(_text(root / _PROCESSOR), "CPUAffinity"))
    control_cpu_folder = cpus / f"cpu{control_cpu or 0}"
    limits = _text(root / "proc/self/limits")
    daemons, softirq = _processes(root / "proc")
    banned = re.search(r"^IRQBALANCE_BANNED_CPULIST=\"?([\d,-]+)", _text(root / "etc/default/irqbalance"), re.MULTILINE)
    return Facts(
        release=_text(root / "proc/sys/kernel/osrelease"),
        preemption=_preemption(root),
        machine=_machine(root),
        online=cpu_set(_text(cpus / "online")),
        control_cpu=control_cpu,
        siblings=cpu_set(_text(control_cpu_folder / "topology/thread_siblings_list")),
        isolated=cpu_set(_text(cpus / "isolated")),
        tickless=cpu_set(_text(cpus / "nohz_full")) or cpu_set(_word(cmdline, "nohz_full")),
        rcu_offloaded=cpu_set(_word(cmdline, "rcu_nocbs")) | cpu_set(_text(cpus / "nohz_full")),
        governors={int(p.parts[-3][3:]): _text(p) for p in sorted(cpus.glob("cpu[0-9]*/cpufreq/scaling_governor"))},
        idle=tuple(_idle_state(p) for p in sorted((control_cpu_folder / "cpuidle").glob("state[0-9]*"))),
        dma_latency=os.access(root / "dev/cpu_dma_latency", os.W_OK),
        clock_source=_text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource"),
        rt_runtime_us=_number(_text(root / "proc/sys/kernel/sched_rt_runtime_us")),
        rt_period_us=_number(_text(root / "proc/sys/kernel/sched_rt_period_us")) or 1_000_000,
        rtprio_limit=_limit(limits, "Max realtime priority"),
        memlock_limit=_limit(limits, "Max locked memory"),
        unit_rtprio=_number(_setting(unit, "LimitRTPRIO")),
        unit_memlock=_number(_setting(unit, "LimitMEMLOCK")),
        unit_there=bool(unit),
        may_prioritise=_capable(root, _CAP_SYS_NICE),
        may_lock=_capable(root, _CAP_IPC_LOCK),
        options=options,
        swap=len(_text(root / "proc/swaps").splitlines()) > 1,
        hugepages=_chosen(_text(root / "sys/kernel/mm/transparent_hugepage/enabled")),
        groups_by_session=_text(root / "proc/sys/kernel/sched_autogroup_enabled") == "1",
        irqbalance="irqbalance" in daemons,
        irqbalance_banned=cpu_set(banned[1]) if banned else frozenset(),
        softirq_threads=softirq,
        slack_ns=_number(_text(root / "proc/self/timerslack_ns")),
        links=tuple(can_links(root, links)),
    )


def read_computer(root: Path, version: str, cpu: int) -> Computer:
    """Describe the computer below ``root``; ``version`` is that of uname(2), ``cpu`` the controller's processor."""
    info = _text(root / "proc/cpuinfo")
    model = re.search(r"^model name\s*:\s*(.+)$", info, re.MULTILINE)
    memory = re.search(r"^MemTotal:\s+(\d+)", _text(root / "proc/meminfo"), re.MULTILINE)
    affinity = {int(p.parent.name): cpu_set(_text(p)) for p in root.glob("proc/irq/[0-9]*/smp_affinity_list")}
    boot_options = _text(root / "proc/cmdline").split()
    return Computer(
        processor=model[1] if model else "",
        processors=len(re.findall(r"^processor\s*:", info, re.MULTILINE)),
        memory_mb=int(memory[1]) >> 10 if memory else 0,
        kernel_version=version,
        boot_words=tuple(w for w in boot_options if BOOT_WORDS.fullmatch(w.partition("=")[0])),
        interrupts=tuple(sorted(n for n, cpus in affinity.items() if cpu in cpus)),
        interrupts_all=len(affinity),
        new_interrupts=_text(root / "proc/irq/default_smp_affinity"),
    )


def interrupt_counts(text: str, cpu: int) -> dict[str, int]:
    """Count interrupts of one processor since boot, by source, from the text of /proc/interrupts."""
    head, *lines = text.splitlines() or [""]
    columns = head.split()
    if f"CPU{cpu}" not in columns:
        return {}
    column, counts = columns.index(f"CPU{cpu}"), dict[str, int]()
    for line in lines:
        label, _, rest = line.strip().partition(":")
        fields = rest.split()
        if len(fields) > column and fields[column].isdigit():
            name = fields[-1] if label.isdigit() and len(fields) > len(columns) else label
            counts[name] = counts.get(name, 0) + int(fields[column])
    return counts


def cpu_set(text: str) -> frozenset[int]:
    """Parse ``0-2,5`` as numbers; words as in ``isolcpus=managed_irq,domain,3`` are ignored."""
    cpus: set[int] = set()
    for part in text.strip().split(","):
        if match := re.fullmatch(r"(\d+)(?:-(\d+))?", part):
            cpus.update(range(int(match[1]), int(match[2] or match[1]) + 1))
    return frozenset(cpus)


def can_links(root: Path, links: str) -> Iterable[CanLink]:
    """Read the CAN interfaces from the output of ip(8)."""
    for link in json.loads(links or "[]"):
        if link.get("link_type") != "can":
            continue
        info: dict[str, Any] = link.get("linkinfo", {})
        data: dict[str, Any] = info.get("info_data", {})
        name = str(link["ifname"])
        interrupts = _interrupts(root, name)
        cpus = [cpu_set(_text(root / f"proc/irq/{n}/smp_affinity_list")) for n in interrupts]
        yield CanLink(
            name=name,
            virtual=info.get("info_kind") in ("vcan", "vxcan"),
            up="UP" in link.get("flags", ()),
            state=str(data.get("state", "")),
            bitrate=int(data.get("bittiming", {}).get("bitrate", 0)),
            sample_point=float(data.get("bittiming", {}).get("sample_point", 0.0)),
            restart_ms=int(data.get("restart_ms", 0)),
            tx_queue=int(link.get("txqlen", 0)),
            counters={k: int(v) for k, v in {**info.get("info_xstats", {}), **data.get("berr_counter", {})}.items()},
            interrupts=interrupts,
            interrupt_cpus=frozenset().union(*cpus),
        )


def _interrupts(root: Path, name: str) -> tuple[int, ...]:
    """List the interrupts of an interface's device, or of its nearest ancestor with any (a USB adapter's host)."""
    device = (root / "sys/class/net" / name / "device").resolve()
    for folder in (device, *device.parents):
        if folder == root.resolve():
            break
        several = sorted(int(p.name) for p in (folder / "msi_irqs").glob("[0-9]*"))
        if several:
            return tuple(several)
        if number := _number(_text(folder / "irq")):
            return (number,)
    return ()


def _preemption(root: Path) -> str:
    """Return rt, full, lazy, voluntary, none or dynamic; empty when unknown."""
    version = _text(root / "proc/version")
    if _text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return "rt"
    chosen = re.search(r"\((\w+)\)", _text(root / "sys/kernel/debug/sched/preempt"))  # readable by root only
    if chosen:
        return chosen[1]
    if "PREEMPT_DYNAMIC" in version:
        word = _word(_text(root / "proc/cmdline"), "preempt")
        return word or "dynamic"
    return "full" if " PREEMPT " in version else ""


def _machine(root: Path) -> str:
    """Return "" for real hardware, else what it is instead."""
    cpuinfo = _text(root / "proc/cpuinfo")
    if "User Mode Linux" in cpuinfo:
        return "user-mode Linux"
    flags = re.search(r"^flags\s*:(.*)$", cpuinfo, re.MULTILINE)
    if flags and "hypervisor" in flags[1].split():
        return "a virtual machine"
    if (root / ".dockerenv").exists() or (root / "run/systemd/container").exists():
        return "a container"
    return ""


def _processes(proc: Path) -> tuple[set[str], dict[int, str]]:
    """Return names of all processes, and the scheduling of the ksoftirqd threads by processor."""
    names: set[str] = set()
    softirq: dict[int, str] = {}
    for stat in proc.glob("[0-9]*/stat"):
        text = _text(stat)
        name, _, rest = text.partition("(")[2].rpartition(")")
        names.add(name)
        if name.startswith("ksoftirqd/"):
            fields = rest.split()
            priority, policy = fields[37], _POLICIES.get(int(fields[38]), fields[38])
            softirq[int(name[10:])] = policy if policy == "OTHER" else f"{policy} {priority}"
    return names, softirq


def _idle_state(place: Path) -> IdleState:
    latency = _number(_text(place / "latency")) or 0
    return IdleState(_text(place / "name"), latency, _text(place / "disable") == "1")


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip("\0\n ")
    except OSError:
        return ""


def _number(text: str) -> int | None:
    if text in ("infinity", "unlimited"):
        return UNLIMITED
    return int(text) if re.fullmatch(r"-?\d+", text) else None


def _limit(limits: str, name: str) -> int | None:
    """Return the hard limit; a process may raise its soft limit up to it."""
    match = re.search(rf"^{name}\s+\S+\s+(\S+)", limits, re.MULTILINE)
    return _number(match[1]) if match else None


def _setting(unit: str, name: str) -> str:
    match = re.search(rf"^{name}=(.*)$", unit, re.MULTILINE)
    return match[1].strip() if match else ""


def _capable(root: Path, bit: int) -> bool:
    match = re.search(r"^CapEff:\s*([0-9a-f]+)", _text(root / "proc/self/status"), re.MULTILINE)
    return match is not None and bool(int(match[1], 16) >> bit & 1)


def _word(cmdline: str, name: str) -> str:
    match = re.search(rf"(?:^|\s){name}=(\S+)", cmdline)
    return match[1] if match else ""


def _chosen(text: str) -> str:
    """Return the selected word, which is in brackets."""
    match = re.search(r"\[(\w+)\]", text)
    return match[1] if match else ""
