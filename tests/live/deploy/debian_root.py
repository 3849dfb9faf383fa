"""A minimal Debian of its own, in which a stranger types commands: nothing of this computer but its kernel and /dev.

`make_root` bootstraps it once, with mmdebstrap from the Debian mirror that this computer uses, and keeps it in the
cache; `DebianRoot` is a layer over it that takes every change.  The stranger is an ordinary user who may use sudo.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SUITE: Final = "bookworm"
USER: Final = "stranger"
TOOLS: Final = ("mmdebstrap", "unshare", "apt-get", "ip")
BOOTSTRAP_S: Final = 900.0
PREPARE: Final = f"""\
useradd --create-home --shell /bin/bash {USER}
echo '{USER} ALL=(ALL) NOPASSWD: ALL' >/etc/sudoers.d/{USER}
runuser --login {USER} --command "$1"
"""
ENTER: Final = f"""\
set -e
mount -t overlay -o "lowerdir=$1,upperdir=$2/changes,workdir=$2/work" overlay "$2/root"
cd "$2/root"
hostname localhost
mount --bind "$2/stick" mnt
mount -t proc proc proc
mount -t sysfs -o ro sysfs sys
mount --rbind /dev dev
mount -t tmpfs -o mode=1777 tmpfs dev/shm
mount -t tmpfs -o mode=755 tmpfs run
ip link set lo up
exec chroot . runuser --login {USER} --command "$3"
"""
"""Own processes, mounts, names and network: the loopback alone.  /run and /dev/shm are as after a start."""


def missing() -> str | None:
    """Why this computer cannot make such a root; None when it can."""
    if lacking := [tool for tool in TOOLS if shutil.which(tool) is None]:
        return f"{lacking[0]} is missing: sh deploy/debian_packages.sh mmdebstrap iproute2"
    if os.geteuid() != 0:
        return "a Debian root needs the rights of root: mounts, and files of other users"
    probe = ["unshare", "--mount", "--pid", "--fork", "--net", "--uts", "--ipc", "true"]
    if subprocess.run(probe, capture_output=True, check=False).returncode:
        return "this computer lets nobody make namespaces (unshare)"
    return None


def cache() -> Path:
    """Where roots and wheels are kept between runs."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "timberhand" / "debian-root"


def make_root(prerequisites: str) -> Path:
    """The folder of a minimal Debian in which the stranger has typed ``prerequisites``, with a network.

    Raises:
        OSError: Debian's mirror does not answer; the sentence is its own.
    """
    key = hashlib.sha256("\n".join((SUITE, platform.machine(), PREPARE, prerequisites)).encode()).hexdigest()[:12]
    made = cache() / f"{SUITE}-{key}"
    if made.is_dir():
        return made
    made.parent.mkdir(parents=True, exist_ok=True)
    unfinished = made.with_suffix(".new")
    # A shell of its own: the hook's words pass through two of them.
    script = made.with_suffix(".sh")
    script.write_text(f'exec chroot "$1" sh -c {_quoted(PREPARE)} sh {_quoted(f"yes | ({prerequisites})")}\n')
    command = [
        "mmdebstrap",
        "--format=directory",
        "--variant=minbase",
        "--include=sudo",
        f'--customize-hook=sh {script} "$1"',
    ]
    done = subprocess.run(
        [*command, SUITE, str(unfinished), *_mirror()], capture_output=True, text=True, timeout=BOOTSTRAP_S, check=False
    )
    script.unlink()
    if done.returncode:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise OSError(f"mmdebstrap: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    unfinished.rename(made)
    return made


def _mirror() -> list[str]:
    """The mirror of this computer's own sources; without one of that suite, mmdebstrap's."""
    command = ["apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages", f"Codename: {SUITE}"]
    found = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    return found[:1]


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "'\\''") + "'"


@dataclass(frozen=True, slots=True)
class DebianRoot:
    """A layer over the root ``made``: its changes lie in ``folder``; ``stick`` in it is a stick, plugged in at /mnt."""

    made: Path
    folder: Path

    @classmethod
    def new(cls, made: Path, folder: Path) -> DebianRoot:
        """A root in which nobody has changed anything yet, in a new folder."""
        for name in ("changes", "work", "root", "stick"):
            (folder / name).mkdir(parents=True)
        return cls(made, folder)

    @property
    def stick(self) -> Path:
        """Put files here to give them to the stranger."""
        return self.folder / "stick"

    def type(self, line: str, timeout_s: float = 300.0) -> subprocess.CompletedProcess[str]:
        """What happens when the stranger logs in and types a line; no network but the loopback."""
        command = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--net", "--uts", "--ipc"]
        return subprocess.run(
            [*command, "sh", "-c", ENTER, "sh", str(self.made), str(self.folder), line],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env={"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"},
        )
