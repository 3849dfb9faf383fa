"""Starts user-mode Linux: its arguments, its environment, its keeper.

Failure: ``LabError`` when there is not the memory, the compiler or the path it needs.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from host.vcan_lab import keeper, shim
from host.vcan_lab.spec import PACKAGE_ROOT, LabError, Request, kernel_arguments

KERNEL = "linux.uml"
_MEMORY_PLACE = "/dev/shm"


def start(kernel: str, request: Request, passed: tuple[int, int, int], log: int) -> subprocess.Popen[bytes]:
    """The keeper's process; closing its standard input ends the lab.

    ``passed``: descriptors of out, err, control; ``log``: where the kernel writes.
    """
    _check_memory(request.mem_mb)
    python = os.path.realpath(sys.executable)
    arguments = kernel_arguments(python, PACKAGE_ROOT, request, *passed)
    env = {"PATH": os.defpath}  # no TMPDIR: the kernel would look there for a place for its memory
    inherited = list(passed)
    preload = None
    if Path(kernel).name == KERNEL and shim.needed(Path("/proc/cpuinfo").read_text()):  # the lab's own has room
        preload = os.open(shim.library(shim.user_cache()), os.O_RDONLY)
        inherited.append(preload)
        env["LD_PRELOAD"] = f"/proc/self/fd/{preload}"  # a path may hold a space or colon, which end it there
    try:
        return subprocess.Popen(
            [sys.executable, "-ISB", keeper.__file__, kernel, *arguments],
            stdin=subprocess.PIPE, stdout=log, stderr=log,
            env=env, cwd="/", start_new_session=True, pass_fds=inherited,
        )  # fmt: skip
    finally:
        if preload is not None:
            os.close(preload)


def _check_memory(mem_mb: int) -> None:
    space = os.statvfs(_MEMORY_PLACE)
    free_mb = space.f_bavail * space.f_frsize >> 20
    if free_mb < mem_mb:
        raise LabError(
            f"the guest's memory lies in {_MEMORY_PLACE}, which has {free_mb} MB free, and {mem_mb} MB are asked for: "
            "give a smaller --mem or make it larger (docker: --shm-size)"
        )
