"""The ptrace shim that user-mode Linux needs on CPUs with AMX, compiled on first use into the user's cache.

Failure: ``LabError`` when there is no C compiler or the cache cannot be written.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from host.vcan_lab.spec import LabError

SOURCE = Path(__file__).with_name("xstate_shim.c")


def needed(cpuinfo: str) -> bool:
    """Whether a CPU's register state (text of /proc/cpuinfo) exceeds the kernel's fixed buffer."""
    flags = re.search(r"^flags\s*:(.*)$", cpuinfo, re.MULTILINE)
    return flags is not None and "amx_tile" in flags[1].split()


def library(cache: Path) -> Path:
    """The compiled shim in the folder ``cache``; compiled when it is missing or older than its source."""
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
    """The cache folder of timberhand (XDG base directories)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "timberhand"
