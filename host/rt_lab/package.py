"""The package of Debian's PREEMPT_RT kernel: downloaded once into the user's cache, and the few files it is for."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Final

from host.vcan_lab.shim import user_cache
from host.vcan_lab.spec import LabError

META_PACKAGE: Final = "linux-image-rt-amd64"
MODULES: Final = ("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan")
"""In the order in which the guest loads them."""
DOWNLOAD_S: Final = 300.0


def kernel_package(show: Callable[[str], None]) -> Path:
    """The newest package that apt knows; kept in the cache, in place of older ones.

    Raises:
        LabError: apt knows none, or it cannot be downloaded.
    """
    try:
        depends = subprocess.run(["apt-cache", "depends", META_PACKAGE], capture_output=True, text=True).stdout
    except OSError:
        depends = ""
    found = re.search(r"Depends: (linux-image-\S*rt-amd64)", depends)
    if not found:
        raise LabError("rt-lab.no-kernel", f"apt knows no {META_PACKAGE}: apt-get update, or give a package (--kernel)")
    cache = user_cache() / "kernels"
    cache.mkdir(parents=True, exist_ok=True)
    if there := sorted(cache.glob(f"{found[1]}_*.deb")):
        return there[-1]
    show(f"downloading {found[1]}, 70 MB")
    done = subprocess.run(
        ["apt-get", "download", found[1]], cwd=cache, capture_output=True, text=True, timeout=DOWNLOAD_S
    )
    there = sorted(cache.glob(f"{found[1]}_*.deb"))
    if done.returncode or not there:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise LabError("rt-lab.no-kernel", f"{found[1]} cannot be downloaded: {reason}")
    for old in set(cache.glob("linux-image-*.deb")) - {there[-1]}:
        old.unlink()
    return there[-1]


def unpack(package: Path, folder: Path) -> tuple[Path, list[Path]]:
    """The kernel and its CAN modules from the package, below ``folder``.

    Raises:
        LabError: the package does not hold them.
    """
    folder.mkdir(parents=True)
    wanted = ["./boot/vmlinuz-*", *(f"*/kernel/{name}.ko" for name in MODULES)]
    with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", package], stdout=subprocess.PIPE) as archive:
        subprocess.run(
            ["tar", "-x", "-C", folder, "--wildcards", *wanted], stdin=archive.stdout, capture_output=True, check=False
        )
    kernel, modules = sorted(folder.glob("boot/vmlinuz-*")), sorted(folder.rglob("*.ko"))
    if len(kernel) != 1 or len(modules) != len(MODULES):
        raise LabError("rt-lab.no-kernel", f"{package.name} is not a Debian kernel with vcan; name another (--kernel)")
    return kernel[0], modules
