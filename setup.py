"""Adds the compiled tick to a wheel: ``TIMBERHAND_COMPILE=1 pip wheel .``; without it the wheel is pure.

Everything else is in pyproject.toml.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
from pathlib import Path

from setuptools import setup

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
