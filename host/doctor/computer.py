"""What a report states about a computer beyond `facts.Facts`: processor, kernel version, boot words, interrupts.

Read below any root, for example a test tree; what is missing is empty.  Nothing here names a person, a host or a disk:
of the kernel's command line only the words of `BOOT_WORDS` are kept.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from host.doctor.facts import cpu_set

BOOT_WORDS: Final = frozenset({
    "isolcpus", "nohz_full", "rcu_nocbs", "irqaffinity", "preempt", "threadirqs", "idle", "processor.max_cstate",
    "intel_idle.max_cstate", "intel_pstate", "amd_pstate", "clocksource", "tsc", "skew_tick", "nosoftlockup",
    "nmi_watchdog", "mitigations", "maxcpus", "nosmt", "mce",
})  # fmt: skip
"""Words of the kernel's command line that change its timing (admin-guide/kernel-parameters)."""


@dataclass(frozen=True, slots=True)
class Computer:
    """``interrupts``: numbers of the interrupts that may use the controller's processor, of ``interrupts_all`` in all.
    ``new_interrupts``: processors that an interrupt uses by default."""

    processor: str
    processors: int
    memory_mb: int
    kernel_version: str
    boot_words: tuple[str, ...]
    interrupts: tuple[int, ...]
    interrupts_all: int
    new_interrupts: str


def read(root: Path, version: str, cpu: int) -> Computer:
    """The computer below ``root``; ``version`` is that of uname(2), ``cpu`` the controller's processor."""
    info = _text(root / "proc/cpuinfo")
    model = re.search(r"^model name\s*:\s*(.+)$", info, re.MULTILINE)
    memory = re.search(r"^MemTotal:\s+(\d+)", _text(root / "proc/meminfo"), re.MULTILINE)
    affinity = {int(p.parent.name): cpu_set(_text(p)) for p in root.glob("proc/irq/[0-9]*/smp_affinity_list")}
    words = _text(root / "proc/cmdline").split()
    return Computer(
        processor=model[1] if model else "",
        processors=len(re.findall(r"^processor\s*:", info, re.MULTILINE)),
        memory_mb=int(memory[1]) >> 10 if memory else 0,
        kernel_version=version,
        boot_words=tuple(w for w in words if w.partition("=")[0] in BOOT_WORDS),
        interrupts=tuple(sorted(n for n, cpus in affinity.items() if cpu in cpus)),
        interrupts_all=len(affinity),
        new_interrupts=_text(root / "proc/irq/default_smp_affinity"),
    )


def interrupt_counts(text: str, cpu: int) -> dict[str, int]:
    """Interrupts of one processor since boot, by source, from the text of /proc/interrupts."""
    head, *lines = text.splitlines() or [""]
    columns = head.split()
    if f"CPU{cpu}" not in columns:
        return {}
    column, found = columns.index(f"CPU{cpu}"), dict[str, int]()
    for line in lines:
        label, _, rest = line.strip().partition(":")
        words = rest.split()
        if len(words) > column and words[column].isdigit():
            name = words[-1] if label.isdigit() and len(words) > len(columns) else label
            found[name] = found.get(name, 0) + int(words[column])
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip("\0\n ")
    except OSError:
        return ""
