"""Which way a lab takes on this machine, and why.

``survey`` looks, ``choose`` decides (pure).  Failure: ``LabError`` names every way's reason.
"""

from __future__ import annotations

import platform
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

from host.vcan_lab import lab_kernel, links, shim
from host.vcan_lab.spec import PACKAGE_ROOT, LabError, Request
from host.vcan_lab.uml import KERNEL

_TRY_NAMESPACE = (
    "import sys; sys.path.append(sys.argv[1]); from host.vcan_lab.links import enter_namespace\n"
    "try: enter_namespace(sys.argv[3:], bool(sys.argv[2]))\n"
    "except OSError as reason: sys.exit(reason.strerror)"
)


@dataclass(frozen=True, slots=True)
class Machine:
    """What counts for the choice; each ``*_fault`` is the reason against a way, None where it works."""

    can_fault: str | None
    existing_fault: str | None
    namespace_fault: str | None
    kernel: str | None
    architecture: str
    lab_kernel: str | None = None


@dataclass(frozen=True, slots=True)
class Way:
    """The way taken, the reason, and the kernel's program for ``uml``."""

    kind: Literal["existing", "namespace", "uml"]
    why: str
    kernel: str | None = None


def choose(machine: Machine, kernel: str | None = None) -> Way:
    """The first way that works: no kernel of its own before one, the machine's interfaces before new ones.

    ``kernel``: as in `Request`; a kernel that is asked for is the only way.
    """
    if kernel is not None:
        natively = f"the {kernel} kernel is asked for"
    elif machine.can_fault is None:
        if machine.existing_fault is None:
            return Way("existing", "the interfaces are there and up")
        if machine.namespace_fault is None:
            return Way("namespace", "the kernel has CAN and vcan")
        natively = f"{machine.existing_fault}, and none can be made ({machine.namespace_fault})"
    else:
        natively = f"this kernel has no AF_CAN ({machine.can_fault})"
    if machine.architecture != "x86_64":
        raise LabError(f"no vcan here: {natively}; user-mode Linux runs on x86_64 only, this is {machine.architecture}")
    if kernel == "lab":
        if machine.lab_kernel is None:
            raise LabError(lab_kernel.MISSING)
        return Way("uml", natively, machine.lab_kernel)
    if machine.kernel is None:
        raise LabError(f"no vcan here: {natively}; {KERNEL} is missing: apt-get install user-mode-linux")
    return Way("uml", natively, machine.kernel)


def survey(request: Request) -> Machine:
    """Look at this machine; tries a network namespace only where it would be needed."""
    can_fault = existing_fault = namespace_fault = None
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as reason:
        can_fault = reason.strerror
    if can_fault is None:
        faults = [f"{name}: {fault}" for name in request.links if (fault := links.state(name))]
        if request.root and request.uid != 0:
            faults.append("--root asks for root")
        existing_fault = "; ".join(faults) or None
        if existing_fault:
            namespace_fault = _namespace_fault(request)
    own = lab_kernel.find(shim.user_cache())
    return Machine(can_fault, existing_fault, namespace_fault, shutil.which(KERNEL), platform.machine(), own)


def _namespace_fault(request: Request) -> str | None:
    as_root = "root" if request.root else ""
    trial = subprocess.run(
        [sys.executable, "-ISB", "-c", _TRY_NAMESPACE, PACKAGE_ROOT, as_root, *request.links],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return (trial.stderr.strip().splitlines() or ["no message"])[-1] if trial.returncode else None
