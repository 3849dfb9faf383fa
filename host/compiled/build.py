"""Compiles the tick into `runtime.compiled.builds_folder`, out of the source tree.

The sources are copied, so that edits during the minute of compilation do no harm; the build gets its place by one
rename.  Of two builders at once the second waits and finds the work done.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from importlib import metadata
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any, Final

from host.compiled.modules import MODULES
from host.compiled.tree import make_tree, needed_sources
from host.exit_codes import CommandFailed
from runtime import compiled

KEPT_BUILDS: Final = 3
"""The newest builds stay, so that a change of branch and back costs nothing."""
LOCK: Final = ".lock"
"""Held by a builder."""
Progress = Callable[[str], None]


def compile_tick(progress: Progress, force: bool = False, root: Path | None = None) -> dict[str, Any]:
    """Make the build for the present sources, unless it is there: its key, folder, modules, seconds, ``new``.

    Raises:
        CommandFailed: no compiler, no mypyc, or the compilation failed; exit code 3.
    """
    root = root or compiled.source_root()
    folder = compiled.builds_folder(root)
    begin_s = time.monotonic()
    existing_build = None if force else compiled.find_build(root, folder)[0]
    if existing_build is None:
        check_tools()
        with _alone(folder, progress):
            existing_build = None if force else compiled.find_build(root, folder)[0]
            if existing_build is None:
                key = _build(root, folder, progress)
                _remove_old(folder, key)
                return _answer(key, folder, begin_s, True)
    return _answer(existing_build.key, folder, begin_s, False)


def check_tools() -> None:
    """Raise CommandFailed when a tool is missing."""
    compiler = (str(sysconfig.get_config_var("CC") or "cc")).split()[0]
    if shutil.which(os.environ.get("CC", "").split(" ")[0] or compiler) is None:
        raise CommandFailed("compile.no-compiler", f"no C compiler ({compiler}): sudo apt-get install gcc")
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        raise CommandFailed("compile.no-headers", "the headers of Python are missing: sudo apt-get install python3-dev")
    for module in ("mypyc", "setuptools"):
        if importlib.util.find_spec(module) is None:
            raise CommandFailed("compile.no-mypyc", f"{module} is missing: pip install 'timberhand[compile]'")


def _build(root: Path, folder: Path, progress: Progress) -> str:
    with tempfile.TemporaryDirectory(prefix=".work-", dir=folder) as work_folder:
        work = Path(work_folder)
        tree, made = work / "tree", work / "made"
        progress("copying the sources, generating the codecs")
        make_tree(root, tree)
        sources = {str(path): compiled.hash_of(tree / path) for path in needed_sources(tree)}
        _run_compiler(tree, made, progress)
        suffix = EXTENSION_SUFFIXES[0]
        files = {
            ".".join(path.relative_to(made).parts).removesuffix(suffix): str(path.relative_to(made))
            for path in sorted(made.rglob(f"*{suffix}"))
        }
        manifest = {
            "platform": compiled.platform_tag(),
            "mypy": metadata.version("mypy"),
            "modules": list(MODULES),
            "sources": sources,
            "files": files,
        }
        (made / compiled.MANIFEST).write_text(json.dumps(manifest, indent=1))
        key = compiled.key_of(manifest)
        target = folder / key
        shutil.rmtree(target, ignore_errors=True)
        made.rename(target)
    progress(f"ready: {key}")
    return key


def _run_compiler(tree: Path, made: Path, progress: Progress) -> None:
    progress("checking types and generating C")
    last: deque[str] = deque(maxlen=12)
    command = [sys.executable, "-m", "host.compiled.extension", str(made)]
    with subprocess.Popen(
        command, cwd=tree, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=_environment(tree)
    ) as process:
        assert process.stdout is not None
        done = 0
        for line in process.stdout:
            last.append(line.rstrip()[:300])
            if line.startswith("building '"):
                # The first extension holds all code; the others are a stub each.
                if done < 2:
                    progress(("compiling C, about a minute", "linking")[done])
                done += 1
    if process.returncode:
        raise CommandFailed("compile.failed", "the tick does not compile; the last lines are:\n" + "\n".join(last))


def _environment(tree: Path) -> dict[str, str]:
    """Return an environment in which the copy comes first, wherever the sources are installed."""
    return {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}


@contextlib.contextmanager
def _alone(folder: Path, progress: Progress) -> Iterator[None]:
    """Hold the folder's lock, and remove what an interrupted builder left."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            progress("another process compiles; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        for leftover in folder.glob(".work-*"):
            shutil.rmtree(leftover, ignore_errors=True)
        yield


def _remove_old(folder: Path, key: str) -> None:
    others = [path.parent for path in folder.glob(f"*/{compiled.MANIFEST}") if path.parent.name != key]
    others.sort(key=lambda path: path.stat().st_mtime)
    for old in others[: max(0, len(others) - (KEPT_BUILDS - 1))]:
        shutil.rmtree(old, ignore_errors=True)


def _answer(key: str, folder: Path, begin_s: float, new: bool) -> dict[str, Any]:
    return {
        "key": key,
        "folder": str(folder / key),
        "modules": len(MODULES),
        "seconds": round(time.monotonic() - begin_s, 1),
        "new": new,
    }
