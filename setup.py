"""Adds the compiled tick to a wheel: ``TIMBERHAND_COMPILE=1 pip wheel .``; without it the wheel is pure.

Everything else is in pyproject.toml.  Two wheels of one commit are the same bytes: the files in them carry the time of
the commit, and without a history that of the first day that an archive knows.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import setup

FIRST_DAY_S = "315532800"
"""1980-01-01: a ZIP archive knows no earlier time."""


def commit_time_s() -> str:
    """Return when this commit was made, as seconds since 1970."""
    project_folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(project_folder), "log", "-1", "--format=%ct", "--", "."]
    try:
        timestamp_s = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return FIRST_DAY_S
    return timestamp_s if (project_folder / ".git").exists() and timestamp_s else FIRST_DAY_S


os.environ.setdefault("SOURCE_DATE_EPOCH", commit_time_s())
if os.environ.get("TIMBERHAND_COMPILE") != "1":
    setup()
elif importlib.util.find_spec("mypyc") is None:
    # pip builds in an environment of its own, and asks first what that needs.
    setup(setup_requires=["mypy==2.4.1", "msgspec>=0.19", "cantools>=45"])
else:
    root = Path(__file__).resolve().parent
    sys.path.insert(0, str(root))
    from host.compiled.extension import extensions
    from host.compiled.tree import make_tree

    tree = root / "build" / "compiled-wheel"
    shutil.rmtree(tree, ignore_errors=True)
    make_tree(root, tree)
    setup(ext_modules=extensions(tree))
