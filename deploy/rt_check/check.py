"""A manual test: the control loop on Debian's PREEMPT_RT kernel, in qemu, without root.

    python deploy/rt_check/check.py [--kernel FILE.deb] [--accel kvm] [--timeout S]

Boots ``linux-image-rt-amd64`` with an initial file system of this Python, this checkout and their dependencies, with a
virtual CAN bus and light emulated nodes.  Starts guard and controller as systemd would, and checks that the kernel is
PREEMPT_RT, that both report READY and run at their FIFO priorities with locked memory, and that the controller reaches
STANDBY, which requires an answer of every encoder.  It says nothing about latency; measure that on the machine's own
computer.

Requires the Debian packages qemu-system-x86 and cpio; downloads the kernel package once into the user's cache.  Takes
some minutes.
Exit status: 0 all checks passed, 2 usage, 3 it cannot run here, 6 a check failed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[1]
META_PACKAGE = "linux-image-rt-amd64"
ENTRIES = (
    "controller.__main__",
    "controller.process.command",
    "controller.guard.__main__",
    "experiments.timing.emulated_machine",
    "host.vcan_lab.links",
    "ctypes",
)
EXCLUDED = ("test", "idlelib", "tkinter", "ensurepip", "lib2to3", "turtledemo", "site-packages", "__pycache__")
LIST_FILES = """
import importlib, json, sys, sysconfig
for name in sys.argv[1:]: importlib.import_module(name)
importlib.import_module("can_dbc.dbc.codec").load("crane")  # also imports what only reading a DBC needs
files = [f for m in list(sys.modules.values()) if (f := getattr(m, "__file__", None))]
maps = {line.split(None, 5)[5].strip() for line in open("/proc/self/maps") if line.count("/")}
print(json.dumps({"files": files, "maps": sorted(maps), "stdlib": sysconfig.get_path("stdlib"),
                  "python": sys.base_prefix + "/bin/python3.11", "site": sysconfig.get_path("purelib")}))
"""
EXPECTED: dict[str, Any] = {
    "guard_ready": True, "controller_ready": True, "standby": True, "controller_policy": "FIFO 80",
    "guard_policy": "FIFO 85", "controller_status": 0,
}  # fmt: skip


class CannotRun(Exception):
    """The check cannot run here; the sentence tells what is missing and how to get it."""


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", type=Path, metavar="FILE", help="a Debian package of a PREEMPT_RT kernel")
    parser.add_argument("--accel", choices=("tcg", "kvm"), default="tcg", help="tcg runs anywhere; kvm is much faster")
    parser.add_argument("--timeout", type=float, default=900.0, metavar="S", help="give up after S seconds")
    options = parser.parse_args()
    began_s = time.monotonic()
    try:
        for program, package in (("qemu-system-x86_64", "qemu-system-x86"), ("cpio", "cpio"), ("dpkg-deb", "dpkg")):
            if shutil.which(program) is None:
                raise CannotRun(f"{program} is missing: sh deploy/debian_packages.sh {package}")
        cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "timberhand"
        with tempfile.TemporaryDirectory(prefix="timberhand-rt-") as place:
            work = Path(place)
            subprocess.run(["dpkg-deb", "-x", options.kernel or fetch(cache), work / "kernel"], check=True)
            result = boot(work, initial_files(work), options.accel, options.timeout)
    except CannotRun as reason:
        say(str(reason))
        return 3
    result["seconds"] = round(time.monotonic() - began_s)
    sys.stdout.write(json.dumps(result, indent=2) + "\n")
    faults = evaluate(result)
    for sentence in faults or ["all checks passed"]:
        say(sentence)
    return 6 if faults else 0


def say(sentence: str) -> None:
    """Print one line on stderr."""
    sys.stderr.write(f"rt check: {sentence}\n")


def evaluate(result: dict[str, Any]) -> list[str]:
    """One sentence for each check that failed."""
    faults = [f"the guest reports: {result['error']}"] if "error" in result else []
    if "PREEMPT_RT" not in result.get("kernel", ""):
        faults.append(f"the kernel is not PREEMPT_RT: {result.get('kernel', 'unknown')}")
    faults += [f"{k} is {result.get(k)}, not {v}" for k, v in EXPECTED.items() if result.get(k) != v]
    faults += [f"{k} is {result.get(k)}" for k in ("controller_locked_kb", "guard_locked_kb", "frames", "ticks")
               if not result.get(k)]  # fmt: skip
    return faults


def fetch(cache: Path) -> Path:
    """The kernel package from the Debian archive; kept in ``cache``."""
    depends = subprocess.run(["apt-cache", "depends", META_PACKAGE], capture_output=True, text=True).stdout
    found = re.search(r"Depends: (linux-image-\S*rt-amd64)", depends)
    if not found:
        raise CannotRun(f"apt knows no {META_PACKAGE}: apt-get update, or name a package with --kernel")
    cache.mkdir(parents=True, exist_ok=True)
    if not (there := sorted(cache.glob(f"{found[1]}_*.deb"))):
        say(f"fetching {found[1]}, 70 MB")
        done = subprocess.run(["apt-get", "download", found[1]], cwd=cache, capture_output=True, text=True)
        there = sorted(cache.glob(f"{found[1]}_*.deb"))
        if not there:
            raise CannotRun(f"{found[1]} cannot be downloaded: {done.stderr.strip().splitlines()[-1:]}")
    return there[-1]


def initial_files(work: Path) -> Path:
    """The archive that the kernel unpacks as its file system: what the processes import, and little else."""
    listed = subprocess.run(
        [sys.executable, "-c", LIST_FILES, *ENTRIES], cwd=CHECKOUT, capture_output=True, text=True, check=True
    )  # fmt: skip
    found = json.loads(listed.stdout)
    site = found["site"]
    libraries = {Path(text) for text in found["maps"] if ".so" in text and Path(text).is_file()}
    files = libraries | {alias for lib in libraries for alias in lib.parent.glob("*.so*") if alias.resolve() == lib}
    files |= {Path("/lib64/ld-linux-x86-64.so.2"), Path(found["python"])}
    files |= set(walk(Path(found["stdlib"])))
    for text in found["files"]:
        if text.startswith(site):
            top = Path(site) / Path(text).relative_to(site).parts[0]
            files |= set(walk(top)) if top.is_dir() else {top}
    modules = [Path(text).relative_to(CHECKOUT) for text in found["files"] if text.startswith(f"{CHECKOUT}/")]
    for package in {path.parts[0] for path in modules if not str(CHECKOUT / path).startswith(site)}:
        files |= set(walk(CHECKOUT / package))
    names = sorted({str(p) for f in files for p in (f, *f.parents) if p != Path("/")})
    own = work / "own"
    (own / "dev").mkdir(parents=True)
    release = next((work / "kernel/lib/modules").iterdir()).name
    for module in (work / "kernel/lib/modules" / release / "kernel").rglob("*.ko"):
        if module.stem in ("can", "can-raw", "can-dev", "vcan"):
            target = own / module.relative_to(work / "kernel")
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(module, target)
    shutil.copy(HERE / "init.py", own / "init.py")
    (own / "init").write_text(f"#!{found['python']} -SB\n" + (HERE / "init.py").read_text())
    (own / "init").chmod(0o755)
    where = {"python": found["python"], "path": [str(CHECKOUT), site]}
    (own / "check.json").write_text(json.dumps(where))
    archive = work / "initrd"
    with archive.open("wb") as out:
        mine = sorted(str(p.relative_to(own)) for p in own.rglob("*"))
        for folder, members in ((Path("/"), [n.lstrip("/") for n in names]), (own, mine)):
            made = subprocess.run(
                ["cpio", "--quiet", "-o", "-H", "newc", "-0", "-L"], input="\0".join(members).encode(), cwd=folder,
                capture_output=True,
            )  # fmt: skip
            if made.returncode:
                raise CannotRun(f"cpio: {made.stderr.decode().strip()}")
            out.write(made.stdout)
    return archive


def walk(folder: Path) -> list[Path]:
    """The files of a package that the guest needs."""
    return [p for p in folder.rglob("*") if p.is_file() and not set(p.relative_to(folder).parts) & set(EXCLUDED)]


def boot(work: Path, archive: Path, accelerator: str, timeout_s: float) -> dict[str, Any]:
    """Run the guest to its end; return its result, or the last lines of its console."""
    kernel = next((work / "kernel/boot").glob("vmlinuz-*"))
    # When emulated, the guest's clock counts instructions, so that a slow host does not delay its loops.
    clock = ["-icount", "shift=0,sleep=off", "-rtc", "clock=vm"] if accelerator == "tcg" else []
    command = [
        "qemu-system-x86_64", "-accel", accelerator, *clock, "-cpu", "max", "-smp", "1", "-m", "1536",
        "-kernel", str(kernel), "-initrd", str(archive), "-append", "console=ttyS0 quiet panic=-1 rdinit=/init",
        "-nographic", "-no-reboot", "-nic", "none",
    ]  # fmt: skip
    size_mb = archive.stat().st_size >> 20
    say(f"booting {kernel.name} with {size_mb} MB of files")
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as guest:
        try:
            console = guest.communicate(timeout=timeout_s)[0].decode(errors="replace")
        except subprocess.TimeoutExpired:
            guest.kill()
            console = guest.communicate()[0].decode(errors="replace")
    answer = re.search(r"RESULT (\{.*\})", console)
    if answer is None:
        before_panic = console.partition("Kernel panic")[0].splitlines()
        return {"error": "no result; the last lines: " + " / ".join(before_panic[-12:])}
    result: dict[str, Any] = json.loads(answer[1])
    result["files_mb"] = size_mb
    if evaluate(result):
        say("the console's end:\n" + console[-4000:])
    return result


if __name__ == "__main__":
    sys.exit(main())
