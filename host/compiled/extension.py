"""The extension modules of the compiled tick, for setuptools; mypyc is imported when they are asked for.

`timberhand compile` runs this module in a copy of the sources, setup.py of a compiled wheel calls `extensions`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from host.compiled.modules import CODECS_MODULE, MODULES, file_of

_MYPY_CONFIG: Final = "[mypy]\npython_version = 3.11\nfollow_imports = silent\nignore_missing_imports = True\n"
_COMPILER_OPTIONS: Final = ("-ffp-contract=off",)
"""No fused multiply-add, which some processors' compilers use unasked: results stay those of the interpreter."""


def extensions() -> list[Any]:
    """The setuptools extensions of `MODULES`; the current directory is the root of the sources."""
    from mypyc.build import mypycify

    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "mypy.ini")
        config.write_text(_MYPY_CONFIG)
        modules = (*MODULES, CODECS_MODULE) if file_of(CODECS_MODULE).is_file() else MODULES
        files = [str(file_of(module)) for module in modules]
        made: list[Any] = mypycify(["--config-file", str(config), *files], opt_level="3", debug_level="0")
    for extension in made:
        extension.extra_compile_args = [*extension.extra_compile_args, *_COMPILER_OPTIONS]
    return made


def main() -> None:
    """Build the extensions into the folder that is the only argument."""
    from setuptools import setup

    (target,) = sys.argv[1:]
    setup(
        name="timberhand-compiled-tick", packages=[], py_modules=[], ext_modules=extensions(),
        script_args=["build_ext", "--build-lib", target],
    )  # fmt: skip


if __name__ == "__main__":
    main()
