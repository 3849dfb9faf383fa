"""Boots the guest, collects its result, and checks it.  Failure: ``LabError``.

The guest prints ``STEP`` lines, then one line ``RESULT`` with a JSON object, on its console.
"""

from __future__ import annotations

import json
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

from host.vcan_lab.spec import PACKAGE_ROOT, LabError
from host.vcan_lab.uml import user_cache

QEMU: Final = "qemu-system-x86_64"
PROGRAMS: Final = {QEMU: "qemu-system-x86", "cpio": "cpio", "dpkg-deb": "dpkg", "cyclictest": "rt-tests"}
MEM_MB: Final = 1536
NEUTRAL_MS: Final = 100.0
"""Limit for the valves after the controller is killed, as in the service lab."""
EXPECTED: Final[dict[str, Any]] = {
    "realtime": "1",
    "guard_ready": True,
    "controller_ready": True,
    "standby": True,
    "controller_policy": "fifo 80",
    "guard_policy": "fifo 85",
    "refused": [],
    "cyclictest_status": 0,
}
POSITIVE: Final = ("controller_locked_kb", "guard_locked_kb", "frames", "ticks", "cyclictest_cycles", "opening_pct")


def missing() -> str | None:
    """Say why this computer cannot run the lab; None when it can, given a kernel package."""
    if platform.machine() != "x86_64":
        return f"the guest needs the packages of this computer, which is {platform.machine()} and not x86_64"
    for program, package in PROGRAMS.items():
        if shutil.which(program) is None:
            return f"{program} is missing: sh deploy/debian_packages.sh {package}"
    return None


def run(package: Path | None, accelerator: str, timeout_s: float, show: Callable[[str], None]) -> dict[str, Any]:
    """Boot the guest and return its result.

    Raises:
        LabError: it cannot run here, or gives no result.
    """
    if fault := missing():
        raise LabError("rt-lab.missing", fault)
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="timberhand-rt-") as folder_name:
        work = Path(folder_name)
        kernel, modules = unpack(package or kernel_package(show), work / "kernel")
        archive = make_archive(work, modules)
        size_mb = archive.stat().st_size >> 20
        show(f"booting {kernel.name} with {size_mb} MB of files")
        result = _boot(kernel, archive, accelerator, timeout_s, show)
    return result | {"files_mb": size_mb, "seconds": round(time.monotonic() - begin_s)}


def evaluate(result: dict[str, Any]) -> list[str]:
    """Return one sentence for each check that failed."""
    faults = [f"the guest reports: {result['error']}"] if "error" in result else []
    if "PREEMPT_RT" not in result.get("kernel", ""):
        faults.append(f"the kernel is not PREEMPT_RT: {result.get('kernel', 'unknown')}")
    faults += [f"{k} is {result.get(k)}, not {v}" for k, v in EXPECTED.items() if result.get(k) != v]
    faults += [f"{k} is {result.get(k)}" for k in POSITIVE if not result.get(k)]
    neutral_ms = result.get("neutral_ms")
    if neutral_ms is None or neutral_ms > NEUTRAL_MS:
        faults.append(f"neutral_ms is {neutral_ms}, the limit {NEUTRAL_MS:g}")
    return faults


def _boot(
    kernel: Path, archive: Path, accelerator: str, timeout_s: float, show: Callable[[str], None]
) -> dict[str, Any]:
    # When emulated, the guest's clock counts instructions, so that a slow host does not delay its loops.
    clock = ["-icount", "shift=0,sleep=off", "-rtc", "clock=vm"] if accelerator == "tcg" else []
    command = [
        QEMU,
        "-accel",
        accelerator,
        *clock,
        "-cpu",
        "max",
        "-smp",
        "1",
        "-m",
        str(MEM_MB),
        "-kernel",
        str(kernel),
        "-initrd",
        str(archive),
        "-append",
        "console=ttyS0 quiet panic=-1 rdinit=/init",
        "-nographic",
        "-no-reboot",
        "-nic",
        "none",
    ]
    console: list[str] = []
    result: dict[str, Any] | None = None
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as guest:
        limit = threading.Timer(timeout_s, guest.kill)
        limit.start()
        try:
            assert guest.stdout
            for line in guest.stdout:
                text = line.decode(errors="replace").rstrip()
                kind, _, rest = text.partition(" ")
                if kind.endswith("RESULT"):
                    result = json.loads(rest)
                elif kind.endswith("STEP"):
                    show(rest)
                else:
                    console.append(text)
        finally:
            limit.cancel()
            guest.kill()
    if result is None:
        raise LabError("rt-lab.no-result", "\n  ".join(["the guest gave no result", *console[-12:]]))
    for text in console if evaluate(result) else ():
        show(f"console: {text}")
    return result


# -- The initial file system of the guest: this Python, this checkout, the packages they import, cyclictest; little
# else.
#
# Byte code comes along, so that no process of the slow guest compiles it again.

CHECKOUT: Final = Path(PACKAGE_ROOT)
GUEST: Final = Path(__file__).with_name("guest.py")
ENTRIES: Final = (
    "controller.__main__",
    "controller.process.command",
    "controller.guard.__main__",
    "experiments.timing.fitness",
    "experiments.timing.sleep_loop",
    "experiments.timing.stand_ins",
    "host.doctor.timing",
    "host.service_lab.trial",
    "host.vcan_lab.links",
    "timberhand.cli",
    "timberhand.commands.doctor",
    "rich.console",
    "ctypes",
)
"""Modules that run in the guest; what they import travels with them."""
EXCLUDED: Final = ("test", "tests", "idlelib", "tkinter", "ensurepip", "lib2to3", "turtledemo", "site-packages")
GUEST_PROGRAMS: Final = ("cyclictest",)
LOADER: Final = Path("/lib64/ld-linux-x86-64.so.2")
LIST_FILES: Final = """
import contextlib, importlib, json, sys, sysconfig
for name in sys.argv[1:]: importlib.import_module(name)
with contextlib.suppress(importlib.import_module("host.exit_codes").CommandFailed):  # ends after the command's imports
    report = ["doctor", "--rt", "--report", "--out", "/nowhere/report.md"]
    importlib.import_module("timberhand.cli").app(report, standalone_mode=False)
importlib.import_module("can_dbc.dbc.codec").load("crane")  # also imports what only reading a DBC needs
files = [f for m in list(sys.modules.values()) if (f := getattr(m, "__file__", None))]
maps = {line.split(None, 5)[5].strip() for line in open("/proc/self/maps") if line.count("/")}
version = f"{sys.version_info.major}.{sys.version_info.minor}"
print(json.dumps({"files": files, "maps": sorted(maps), "stdlib": sysconfig.get_path("stdlib"),
                  "python": f"{sys.base_prefix}/bin/python{version}", "site": sysconfig.get_path("purelib")}))
"""


def make_archive(work: Path, modules: Iterable[Path]) -> Path:
    """Make the archive that the kernel unpacks as its file system; ``modules`` lie below ``work/kernel``.

    Raises:
        LabError: the modules cannot be imported here, or cpio fails.
    """
    listed = subprocess.run(
        [sys.executable, "-c", LIST_FILES, *ENTRIES], cwd=CHECKOUT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        raise LabError("rt-lab.archive", f"a module of the guest cannot be imported: {listed.stderr.strip()[-300:]}")
    imports = json.loads(listed.stdout)
    files = {Path(imports["python"]), LOADER} | _libraries(imports["maps"]) | set(walk(Path(imports["stdlib"])))
    files |= _packages(imports["files"], Path(imports["site"])) | _checkout(imports["files"], imports["site"])
    for program in filter(None, map(shutil.which, GUEST_PROGRAMS)):
        files |= {Path(program), *_linked(program)}
    own = work / "own"
    (own / "dev").mkdir(parents=True)
    for module in modules:
        target = own / module.relative_to(work / "kernel")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(module, target)
    (own / "init").write_text(f"#!{imports['python']} -SB\n" + GUEST.read_text())
    (own / "init").chmod(0o755)
    order = {"python": imports["python"], "path": [str(CHECKOUT), imports["site"]]}
    (own / "order.json").write_text(json.dumps(order))
    names = sorted({str(p).lstrip("/") for f in files for p in (f, *f.parents) if p != Path("/")})
    own_names = sorted(str(p.relative_to(own)) for p in own.rglob("*"))
    archive = work / "initrd"
    with archive.open("wb") as out:
        for folder, members in ((Path("/"), names), (own, own_names)):
            made = subprocess.run(
                ["cpio", "--quiet", "-o", "-H", "newc", "-0", "-L"],
                input="\0".join(members).encode(),
                cwd=folder,
                capture_output=True,
                check=False,
            )
            if made.returncode:
                raise LabError("rt-lab.archive", f"cpio: {made.stderr.decode().strip()[-300:]}")
            out.write(made.stdout)
    return archive


def walk(folder: Path) -> list[Path]:
    """List the files of a package that the guest needs."""
    return [p for p in folder.rglob("*") if p.is_file() and not set(p.relative_to(folder).parts) & set(EXCLUDED)]


def _libraries(maps: Iterable[str]) -> set[Path]:
    """Find the loaded shared libraries, under every name that the loader may look for."""
    libraries = {Path(text) for text in maps if ".so" in text and Path(text).is_file()}
    return libraries | {alias for lib in libraries for alias in lib.parent.glob("*.so*") if alias.resolve() == lib}


def _packages(files: Iterable[str], site: Path) -> set[Path]:
    """Find the installed packages of these files, with the libraries that their wheels bundle in ``NAME.libs``."""
    tops = {Path(text).relative_to(site).parts[0] for text in files if Path(text).is_relative_to(site)}
    paths: set[Path] = set()
    for top in tops | {f"{name}.libs" for name in tops}:
        package_path = site / top
        paths |= (
            set(walk(package_path)) if package_path.is_dir() else {package_path} if package_path.is_file() else set()
        )
    return paths


def _checkout(files: Iterable[str], site: str) -> set[Path]:
    """Find our packages, and the compiled tick beside them if there is one."""
    package_names = {
        Path(t).relative_to(CHECKOUT).parts[0] for t in files if Path(t).is_relative_to(CHECKOUT) and site not in t
    }
    folders = [CHECKOUT / name for name in package_names] + [CHECKOUT / "build" / "compiled"]
    return {p for folder in folders if folder.is_dir() for p in walk(folder)}


def _linked(program: str) -> set[Path]:
    """Find the shared libraries of a program."""
    ldd_output = subprocess.run(["ldd", program], capture_output=True, text=True, check=False).stdout
    return {Path(text) for text in re.findall(r"(/\S+) \(0x", ldd_output)}


# -- The package of Debian's PREEMPT_RT kernel: downloaded once into the user's cache, and the few files it is for.

META_PACKAGE: Final = "linux-image-rt-amd64"
MODULES: Final = ("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan")
"""In the order in which the guest loads them."""
DOWNLOAD_S: Final = 300.0


def kernel_package(show: Callable[[str], None]) -> Path:
    """Get the newest package that apt knows; kept in the cache, in place of older ones.

    Raises:
        LabError: apt knows none, or it cannot be downloaded.
    """
    try:
        depends = subprocess.run(["apt-cache", "depends", META_PACKAGE], capture_output=True, text=True).stdout
    except OSError:
        depends = ""
    match = re.search(r"Depends: (linux-image-\S*rt-amd64)", depends)
    if not match:
        raise LabError("rt-lab.no-kernel", f"apt knows no {META_PACKAGE}: apt-get update, or give a package (--kernel)")
    cache = user_cache() / "kernels"
    cache.mkdir(parents=True, exist_ok=True)
    if packages := sorted(cache.glob(f"{match[1]}_*.deb")):
        return packages[-1]
    show(f"downloading {match[1]}, 70 MB")
    done = subprocess.run(
        ["apt-get", "download", match[1]], cwd=cache, capture_output=True, text=True, timeout=DOWNLOAD_S
    )
    packages = sorted(cache.glob(f"{match[1]}_*.deb"))
    if done.returncode or not packages:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise LabError("rt-lab.no-kernel", f"{match[1]} cannot be downloaded: {reason}")
    for old in set(cache.glob("linux-image-*.deb")) - {packages[-1]}:
        old.unlink()
    return packages[-1]


def unpack(package: Path, folder: Path) -> tuple[Path, list[Path]]:
    """Unpack the kernel and its CAN modules from the package, below ``folder``.

    Raises:
        LabError: the package does not hold them.
    """
    folder.mkdir(parents=True)
    patterns = ["./boot/vmlinuz-*", *(f"*/kernel/{name}.ko" for name in MODULES)]
    with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", package], stdout=subprocess.PIPE) as archive:
        subprocess.run(
            ["tar", "-x", "-C", folder, "--wildcards", *patterns],
            stdin=archive.stdout,
            capture_output=True,
            check=False,
        )
    kernel, modules = sorted(folder.glob("boot/vmlinuz-*")), sorted(folder.rglob("*.ko"))
    if len(kernel) != 1 or len(modules) != len(MODULES):
        raise LabError("rt-lab.no-kernel", f"{package.name} is not a Debian kernel with vcan; name another (--kernel)")
    return kernel[0], modules
