"""Chooses the method of the lab on this computer.

``survey`` inspects the computer, ``choose`` decides (pure).  Failure: ``LabError`` with the reason against each method.
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
    """The first method that works: native before user-mode Linux, existing interfaces before new ones.

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
            raise LabError("lab.no-lab-kernel", lab_kernel.MISSING)
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
    own = lab_kernel.find(shim.user_cache())
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
