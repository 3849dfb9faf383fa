"""The request to the lab, and what is derived from it: kernel arguments and the order to the guest.  Pure.

Failure: ``LabError``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from runtime.errors import TimberhandError

DEFAULT_LINKS: Final = ("vcan0", "vcan1")
DEFAULT_MEM_MB: Final = 1024
DEFAULT_BOOT_TIMEOUT_S: Final = 60.0
PACKAGE_ROOT: Final = str(Path(__file__).resolve().parents[2])
"""The folder that holds the package ``host``."""
GUEST_RUNTIME_DIR: Final = "/dev/runtime"
RUN_GUEST: Final = "import sys; sys.path.append(sys.argv[1]); from host.vcan_lab.guest import main; main(sys.argv[2:])"
"""Loads the guest without site-packages: ``python -ISB -c RUN_GUEST <PACKAGE_ROOT> [descriptors]``."""

VIRTUAL_START_NS: Final = 1_767_225_600_000_000_000
"""The wall clock at the start of simulated time, 2026-01-01, so that runs have equal time stamps."""

_CON_OUT, _CON_ERR, _CON_CONTROL = 1, 2, 3
_IFNAMSIZ = 15


class LabError(TimberhandError):
    """The lab cannot be provided; the sentence tells why and what to do."""


@dataclass(frozen=True, slots=True)
class Request:
    """A command and its environment; ``uid``, ``gid``, ``groups`` are those of the caller.

    ``kernel``: a user-mode kernel by name, Debian's or the lab's own; None takes the first method that works.
    ``time_travel``: simulated time, which only the lab's own kernel has.
    """

    argv: tuple[str, ...]
    cwd: str
    env: Mapping[str, str]
    uid: int
    gid: int
    groups: tuple[int, ...]
    umask: int
    links: tuple[str, ...] = DEFAULT_LINKS
    root: bool = False
    mem_mb: int = DEFAULT_MEM_MB
    timeout_s: float | None = None
    boot_timeout_s: float = DEFAULT_BOOT_TIMEOUT_S
    kernel: Literal["debian", "lab"] | None = None
    time_travel: bool = False


def link_fault(name: str) -> str | None:
    """Say why ``name`` is not an interface name (linux/if.h); None when it is one."""
    if not 0 < len(name.encode()) <= _IFNAMSIZ:
        return f"interface name {name!r} must have 1 to {_IFNAMSIZ} bytes"
    if name in (".", "..") or "/" in name or ":" in name or any(c.isspace() for c in name):
        return f"interface name {name!r} must not contain a slash, colon or space"
    return None


def order(request: Request, lab: str, new_links: bool, needed: Sequence[str] = ()) -> dict[str, Any]:
    """Write the first message on the control channel, ready for JSON: everything that the guest needs.

    ``new_links``: create the interfaces.  ``needed``: further paths that the guest must see.
    """
    env = {**request.env, "TIMBERHAND_LAB": lab}
    if lab == "uml":  # Unix sockets belong to one kernel: the guest must not find or replace those of the host
        env["XDG_RUNTIME_DIR"] = GUEST_RUNTIME_DIR
    needed = [request.cwd, *needed, *request.argv, *filter(None, (env.get("TMPDIR"), env.get("VIRTUAL_ENV")))]
    return {
        "argv": list(request.argv),
        "env": env,
        "cwd": request.cwd,
        "user": None if request.root else [request.uid, request.gid, list(request.groups)],
        "umask": request.umask,
        "links": list(request.links) if new_links else [],
        "as_root": request.root,
        "host_shm": _holds("/dev/shm", needed),  # asked only  # nosec B108
    }


def kernel_arguments(
    python: str, package_root: str, request: Request, out_fd: int, err_fd: int, control_fd: int
) -> list[str]:
    """List arguments of ``linux.uml``: the host's root file system, three consoles on descriptors, the guest as init.

    The guest makes the root file system writable, without access times.

    No other console and no file of the kernel: nothing can be created in ``uml_dir``.  The two blacklisted initcalls
    only measure RAID algorithms and take two thirds of the boot time.
    """
    travel = ["time-travel=inf-cpu", f"time-travel-start={VIRTUAL_START_NS}"] if request.time_travel else []
    return [
        f"mem={request.mem_mb}M",
        "root=none",
        "rootfstype=hostfs",
        "rootflags=/",
        "ro",
        "con=null",
        "con0=null,fd:1",
        "ssl=null",
        f"con{_CON_OUT}=null,fd:{out_fd}",
        f"con{_CON_ERR}=null,fd:{err_fd}",
        f"con{_CON_CONTROL}=fd:{control_fd}",
        "uml_dir=/proc/",
        "quiet",
        "panic=1",
        "noreboot",
        "initcall_blacklist=raid6_select_algo,calibrate_xor_blocks",
        *travel,
        f"init={_quoted(python)}",
        "--",
        "-ISB",
        "-c",
        _quoted(RUN_GUEST),
        _quoted(package_root),
    ]


def _quoted(text: str) -> str:
    """Quote ``text`` as one word of a kernel command line, which has double quotes but no escapes."""
    if '"' in text or "\n" in text:
        raise LabError(
            "lab.path", f"the kernel's command line cannot hold the path {text!r}; use a path without quotes"
        )
    return f'"{text}"'


def _holds(folder: str, paths: Sequence[str]) -> bool:
    folder = folder.rstrip("/")
    return any(path == folder or path.startswith(folder + "/") for path in paths)
