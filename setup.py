"""Adds the compiled tick to a wheel: ``TIMBERHAND_COMPILE=1 pip wheel .``; without it the wheel is pure.

Everything else is in pyproject.toml.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

from setuptools import setup

if os.environ.get("TIMBERHAND_COMPILE") != "1":
    setup()
elif importlib.util.find_spec("mypyc") is None:
    # pip builds in an environment of its own, and asks first what that needs.
    setup(setup_requires=["mypy==2.4.1", "msgspec>=0.19"])
else:
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    from host.compiled.extension import extensions

    setup(ext_modules=extensions())
