"""Starts user-mode Linux with its arguments, environment and keeper.

Failure: ``LabError`` when memory or compiler are missing, or a path cannot be passed.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from host.vcan_lab import keeper, shim
from host.vcan_lab.spec import PACKAGE_ROOT, LabError, Request, kernel_arguments

KERNEL = "linux.uml"
_MEMORY_FOLDER = "/dev/shm"  # looked at only; the kernel names its own file there  # nosec B108


def start(kernel: str, request: Request, passed: tuple[int, int, int], log: int) -> subprocess.Popen[bytes]:
    """The process of the keeper; closing its standard input ends the lab.

    ``passed``: descriptors of out, err, control; ``log``: descriptor for the kernel's output.
    """
    _check_memory(request.mem_mb)
    python = os.path.realpath(sys.executable)
    arguments = kernel_arguments(python, PACKAGE_ROOT, request, *passed)
    env = {"PATH": os.defpath}  # no TMPDIR: the kernel would put its memory file there
    inherited = list(passed)
    preload = None
    if Path(kernel).name == KERNEL and shim.needed(
        Path("/proc/cpuinfo").read_text()
    ):  # the lab's own kernel has a larger buffer
        preload = os.open(shim.library(shim.user_cache()), os.O_RDONLY)
        inherited.append(preload)
        env["LD_PRELOAD"] = (
            f"/proc/self/fd/{preload}"  # a path might contain a space or colon, which are separators there
        )
    try:
        return subprocess.Popen(
            [sys.executable, "-ISB", keeper.__file__, kernel, *arguments],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=env,
            cwd="/",
            start_new_session=True,
            pass_fds=inherited,
        )
    finally:
        if preload is not None:
            os.close(preload)


def _check_memory(mem_mb: int) -> None:
    space = os.statvfs(_MEMORY_FOLDER)
    free_mb = space.f_bavail * space.f_frsize >> 20
    if free_mb < mem_mb:
        raise LabError(
            "lab.memory",
            f"the guest's {mem_mb} MB of memory do not fit into {_MEMORY_FOLDER}, which has {free_mb} MB free; "
            "use a smaller --mem or enlarge it (docker: --shm-size)",
        )
