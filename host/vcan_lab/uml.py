"""Starts user-mode Linux with its arguments, environment and keeper.

Failure: ``LabError`` when memory or compiler are missing, or a path cannot be passed.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

from host.vcan_lab import keeper
from host.vcan_lab.spec import PACKAGE_ROOT, LabError, Request, kernel_arguments

KERNEL = "linux.uml"
_MEMORY_FOLDER = "/dev/shm"  # looked at only; the kernel names its own file there  # nosec B108


def start(kernel: str, request: Request, passed: tuple[int, int, int], log: int) -> subprocess.Popen[bytes]:
    """Start the process of the keeper; closing its standard input ends the lab.

    ``passed``: descriptors of out, err, control; ``log``: descriptor for the kernel's output.
    """
    _check_memory(request.mem_mb)
    python = os.path.realpath(sys.executable)
    arguments = kernel_arguments(python, PACKAGE_ROOT, request, *passed)
    env = {"PATH": os.defpath}  # no TMPDIR: the kernel would put its memory file there
    inherited = list(passed)
    preload = None
    if Path(kernel).name == KERNEL and needed(
        Path("/proc/cpuinfo").read_text()
    ):  # the lab's own kernel has a larger buffer
        preload = os.open(library(user_cache()), os.O_RDONLY)
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


# -- The ptrace shim that user-mode Linux needs on CPUs with AMX, compiled on first use into the user's cache.
#
# Failure: ``LabError`` when there is no C compiler or the cache cannot be written.

SOURCE = Path(__file__).with_name("xstate_shim.c")


def needed(cpuinfo: str) -> bool:
    """Tell whether a CPU's register state (text of /proc/cpuinfo) exceeds the kernel's fixed buffer."""
    flags = re.search(r"^flags\s*:(.*)$", cpuinfo, re.MULTILINE)
    return flags is not None and "amx_tile" in flags[1].split()


def library(cache: Path) -> Path:
    """Return the compiled shim in the folder ``cache``; compile it when it is missing or older than its source."""
    built = cache / "xstate_shim.so"
    if built.exists() and built.stat().st_mtime >= SOURCE.stat().st_mtime:
        return built
    compiler = shutil.which("cc")
    if compiler is None:
        raise LabError(
            "lab.no-compiler",
            "on a CPU with AMX the lab needs a C compiler for its shim: apt-get install gcc libc6-dev",
        )
    part = built.with_suffix(f".{os.getpid()}")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", part, SOURCE], check=True, capture_output=True, text=True
        )
        part.replace(built)
    except OSError as reason:
        raise LabError(
            "lab.shim-cache", f"the shim cannot be written to {cache}: {reason.strerror}; set XDG_CACHE_HOME"
        ) from None
    except subprocess.CalledProcessError as failure:
        part.unlink(missing_ok=True)
        lines = failure.stderr.strip().splitlines() or ["no message"]
        raise LabError(
            "lab.shim-compilation",
            f"{compiler} does not compile {SOURCE}: {lines[0]}; try apt-get install gcc libc6-dev",
        ) from None
    return built


def user_cache() -> Path:
    """Return the cache folder of timberhand (XDG base directories)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "timberhand"


# -- The optional user-mode kernel of the lab; ``make lab-kernel`` (deploy/lab_kernel) builds it into the user's cache.

CONFIG: Final = Path(PACKAGE_ROOT, "deploy/lab_kernel/lab.config")
MISSING: Final = "the lab kernel is not built: make lab-kernel"


def find(cache: Path) -> str | None:
    """Find the newest kernel in the folder ``cache`` built from the present configuration; None when there is none."""
    try:
        digest = hashlib.sha256(CONFIG.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:  # an installation without the checkout
        return None
    built = sorted(cache.glob(f"linux-*-{digest}"), key=lambda kernel: kernel.stat().st_mtime)
    return str(built[-1]) if built else None
