"""Chooses the method of the lab on this computer.

``survey`` inspects the computer, ``choose`` decides (pure).  Failure: ``LabError`` with the reason against each method.
"""

from __future__ import annotations

import os
import platform
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from typing import Final, Literal

from host.real_time import LOOK_S, run_probe
from host.vcan_lab import links, lost_time, uml
from host.vcan_lab.spec import PACKAGE_ROOT, LabError, Request
from host.vcan_lab.uml import KERNEL

_TRY_NAMESPACE = (
    "import sys; sys.path.append(sys.argv[1]); from host.vcan_lab.links import enter_namespace\n"
    "try: enter_namespace(sys.argv[3:], bool(sys.argv[2]))\n"
    "except OSError as reason: sys.exit(reason.strerror)"
)


@dataclass(frozen=True, slots=True)
class HostFacts:
    """The facts for the choice; each ``*_fault`` is the reason against a method, None when it works."""

    can_fault: str | None
    existing_fault: str | None
    namespace_fault: str | None
    kernel: str | None
    architecture: str
    lab_kernel: str | None = None


@dataclass(frozen=True, slots=True)
class Method:
    """The method, the reason for it, and the kernel program for ``uml``."""

    kind: Literal["existing", "namespace", "uml"]
    reason: str
    kernel: str | None = None


def choose(facts: HostFacts, kernel: str | None = None) -> Method:
    """Choose the first method that works: native before user-mode Linux, existing interfaces before new ones.

    ``kernel``: as in `Request`; a requested kernel is the only method.

    Raises:
        LabError: no method works.
    """
    if kernel is not None:
        natively = f"the {kernel} kernel is requested"
    elif facts.can_fault is None:
        if facts.existing_fault is None:
            return Method("existing", "the interfaces exist and are up")
        if facts.namespace_fault is None:
            return Method("namespace", "the kernel has CAN and vcan")
        natively = f"{facts.existing_fault}, and none can be created ({facts.namespace_fault})"
    else:
        natively = f"this kernel has no AF_CAN ({facts.can_fault})"
    if facts.architecture != "x86_64":
        raise LabError(
            "lab.architecture",
            f"no vcan here: {natively}; user-mode Linux runs on x86_64 only, this is {facts.architecture}",
        )
    if kernel == "lab":
        if facts.lab_kernel is None:
            raise LabError("lab.no-lab-kernel", uml.MISSING)
        return Method("uml", natively, facts.lab_kernel)
    if facts.kernel is None:
        raise LabError("lab.no-uml", f"no vcan here: {natively}; {KERNEL} is missing: apt-get install user-mode-linux")
    return Method("uml", natively, facts.kernel)


def survey(request: Request) -> HostFacts:
    """Inspect this computer; a network namespace is tried only where it would be used."""
    can_fault = existing_fault = namespace_fault = None
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as reason:
        can_fault = reason.strerror
    if can_fault is None:
        faults = [f"{name}: {fault}" for name in request.links if (fault := links.state(name))]
        if request.root and request.uid != 0:
            faults.append("--root requires root")
        existing_fault = "; ".join(faults) or None
        if existing_fault:
            namespace_fault = _namespace_fault(request)
    own = uml.find(uml.user_cache())
    return HostFacts(can_fault, existing_fault, namespace_fault, shutil.which(KERNEL), platform.machine(), own)


def _namespace_fault(request: Request) -> str | None:
    as_root = "root" if request.root else ""
    trial = subprocess.run(
        [sys.executable, "-ISB", "-c", _TRY_NAMESPACE, PACKAGE_ROOT, as_root, *request.links],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    return (trial.stderr.strip().splitlines() or ["no message"])[-1] if trial.returncode else None


# -- Real or simulated time for a live run in user-mode Linux, by the processor time that the lab would get.
#
# The guest has one processor and needs nearly all of it for a live machine (about nine tenths, measured), so a host
# that takes more than a tenth leaves the processes of lowest priority, the planner among them, with too little:
# setpoints come late and leases end.  The controller does nothing wrong then, and a faster host does not have the
# problem; so the run takes place in simulated time, which shows what the processes do and not what the host does.
#
# ``measure`` looks at the host for a moment, ``choose_clock`` decides (pure), ``clock_here`` does both.

MAX_LOST_SHARE: Final = 0.08
"""The guest has about a tenth to spare."""
MAX_GAP_NS: Final = 25_000_000
"""Half of a motion input's time-out of 50 ms: the guest needs the other half to catch up."""


@dataclass(frozen=True, slots=True)
class LostTime:
    """What a process with the lab's share did not get of its processor.

    ``share``: of the time, in gaps; ``longest_ns``: the longest gap; ``steal_share``: of the time, taken by the
    hypervisor according to /proc/stat (a part of ``share``; the rest went to other processes of this computer).
    """

    share: float
    longest_ns: int
    steal_share: float

    def words(self) -> str:
        """Describe the lost time for a person."""
        return (
            f"{100 * self.share:.0f} % of its processor's time lost, at most {self.longest_ns / 1e6:.0f} ms at once "
            f"(steal by the hypervisor: {100 * self.steal_share:.1f} %)"
        )


@dataclass(frozen=True, slots=True)
class Clock:
    """The chosen clock, and why."""

    kind: Literal["real", "simulated"]
    reason: str
    enough: bool = True
    """Whether the run may be expected to take place without a stop."""


def choose_clock(lost: LostTime, kernel: str | None, detects: bool = False) -> Clock:
    """Choose real time where the host leaves enough; else simulated time, if the lab's own kernel ``kernel`` is there.

    ``detects``: a camera's detector runs in the guest, which needs more than its one processor.
    """
    if lost.share <= MAX_LOST_SHARE and lost.longest_ns <= MAX_GAP_NS and not detects:
        return Clock("real", f"the host leaves the lab enough: {lost.words()}")
    busy = f"the host is too busy for a live run in user-mode Linux: {lost.words()}"
    if detects:
        busy = "a live run with a camera needs more than the one processor of user-mode Linux"
    if kernel is None:
        return Clock("real", f"{busy}; expect stops, or use simulated time: {uml.MISSING}", enough=False)
    return Clock("simulated", busy)


def measure(seconds: float = LOOK_S) -> LostTime:
    """Spin beside everything else on the processor and with the share that the lab would get.

    Raises:
        subprocess.SubprocessError: the probe fails.
    """
    probe_result = run_probe(lost_time.__file__, seconds)
    return LostTime(probe_result["share"], probe_result["longest_ns"], probe_result["steal_share"])


def clock_here(detects: bool = False) -> Clock | None:
    """Choose the clock for a live run in the lab now; None where the lab is not user-mode Linux, or there is none.

    ``detects``: as in `choose_clock`.
    """
    request = Request((), os.getcwd(), {}, os.getuid(), os.getgid(), (), 0o022)
    try:
        if choose(survey(request)).kind != "uml":
            return None
    except LabError:
        return None  # the lab itself says why
    return choose_clock(measure(), uml.find(uml.user_cache()), detects)
