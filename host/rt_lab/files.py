"""The initial file system of the guest: this Python, this checkout, the packages they import, cyclictest; little else.

Byte code comes along, so that no process of the slow guest compiles it again.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from host.vcan_lab.spec import PACKAGE_ROOT, LabError

CHECKOUT: Final = Path(PACKAGE_ROOT)
GUEST: Final = Path(__file__).with_name("guest.py")
ENTRIES: Final = (
    "controller.__main__",
    "controller.process.command",
    "controller.guard.__main__",
    "experiments.timing.bus_observer",
    "experiments.timing.emulated_machine",
    "experiments.timing.fitness",
    "experiments.timing.setpoint_source",
    "experiments.timing.sleep_loop",
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
PROGRAMS: Final = ("cyclictest",)
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
    """The archive that the kernel unpacks as its file system; ``modules`` lie below ``work/kernel``.

    Raises:
        LabError: the modules cannot be imported here, or cpio fails.
    """
    listed = subprocess.run(
        [sys.executable, "-c", LIST_FILES, *ENTRIES], cwd=CHECKOUT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        raise LabError("rt-lab.archive", f"a module of the guest cannot be imported: {listed.stderr.strip()[-300:]}")
    found = json.loads(listed.stdout)
    files = {Path(found["python"]), LOADER} | _libraries(found["maps"]) | set(walk(Path(found["stdlib"])))
    files |= _packages(found["files"], Path(found["site"])) | _checkout(found["files"], found["site"])
    for program in filter(None, map(shutil.which, PROGRAMS)):
        files |= {Path(program), *_linked(program)}
    own = work / "own"
    (own / "dev").mkdir(parents=True)
    for module in modules:
        target = own / module.relative_to(work / "kernel")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(module, target)
    (own / "init").write_text(f"#!{found['python']} -SB\n" + GUEST.read_text())
    (own / "init").chmod(0o755)
    order = {"python": found["python"], "path": [str(CHECKOUT), found["site"]]}
    (own / "order.json").write_text(json.dumps(order))
    names = sorted({str(p).lstrip("/") for f in files for p in (f, *f.parents) if p != Path("/")})
    mine = sorted(str(p.relative_to(own)) for p in own.rglob("*"))
    archive = work / "initrd"
    with archive.open("wb") as out:
        for folder, members in ((Path("/"), names), (own, mine)):
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
    """The files of a package that the guest needs."""
    return [p for p in folder.rglob("*") if p.is_file() and not set(p.relative_to(folder).parts) & set(EXCLUDED)]


def _libraries(maps: Iterable[str]) -> set[Path]:
    """The loaded shared libraries, under every name that the loader may look for."""
    libraries = {Path(text) for text in maps if ".so" in text and Path(text).is_file()}
    return libraries | {alias for lib in libraries for alias in lib.parent.glob("*.so*") if alias.resolve() == lib}


def _packages(files: Iterable[str], site: Path) -> set[Path]:
    """The installed packages of these files, with the libraries that their wheels bundle in ``NAME.libs``."""
    tops = {Path(text).relative_to(site).parts[0] for text in files if Path(text).is_relative_to(site)}
    found: set[Path] = set()
    for top in tops | {f"{name}.libs" for name in tops}:
        there = site / top
        found |= set(walk(there)) if there.is_dir() else {there} if there.is_file() else set()
    return found


def _checkout(files: Iterable[str], site: str) -> set[Path]:
    """Our packages, and the compiled tick beside them if there is one."""
    ours = {Path(t).relative_to(CHECKOUT).parts[0] for t in files if Path(t).is_relative_to(CHECKOUT) and site not in t}
    folders = [CHECKOUT / name for name in ours] + [CHECKOUT / "build" / "compiled"]
    return {p for folder in folders if folder.is_dir() for p in walk(folder)}


def _linked(program: str) -> set[Path]:
    """The shared libraries of a program."""
    told = subprocess.run(["ldd", program], capture_output=True, text=True, check=False).stdout
    return {Path(text) for text in re.findall(r"(/\S+) \(0x", told)}
