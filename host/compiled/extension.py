"""The extension modules of the compiled tick, for setuptools; mypyc is imported when they are asked for.

`timberhand compile` runs this module in a copy of the sources (`host.compiled.tree`), setup.py of a compiled wheel
makes such a copy and calls `extensions`.
"""

from __future__ import annotations

import contextlib
import re
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from host.compiled.modules import CODECS_MODULE, MODULES, file_of

_MYPY_CONFIG: Final = "[mypy]\npython_version = 3.11\nfollow_imports = silent\nignore_missing_imports = True\n"
_CONTRACT_OFF: Final = "-ffp-contract=off"
"""No fused multiply-add, which some processors' compilers use unasked: results stay those of the interpreter."""
COLD_PATHS: Final = Path("host", "compiled", "cold_paths.h")
HOT_FUNCTIONS: Final = Path("host", "compiled", "hot_functions.txt")
"""C names of the functions that `step` calls, one a line; made by `hil.tick.hot_functions`."""
_LOOP_MODULES: Final = (
    "batch",
    "bus_link",
    "durations",
    "loop",
    "reconnector",
    "record_ring",
    "tick_record",
    "tick_recording",
    "timing",
    "wire_records",
)
"""Modules around `step`: what a tick calls of them it calls on every bus, which no replay has."""
_PROTOTYPE: Final = re.compile(r"^(?:extern )?\w[\w *]*?\b(CPy(?:Def|Py)_\w+)\(.*\);$", re.MULTILINE)
_AT_START: Final = ("_____top_level__", "_coroutine_setup")


def extensions(tree: Path) -> list[Any]:
    """Make the setuptools extensions of `MODULES` and of the generated codecs; ``tree`` is a copy of the sources."""
    from mypyc.build import mypycify

    tree = tree.resolve()
    files = [str(file_of(module)) for module in (*MODULES, CODECS_MODULE)]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(tree):
        config = Path(folder, "mypy.ini")
        config.write_text(_MYPY_CONFIG)
        made: list[Any] = mypycify(["--config-file", str(config), *files], opt_level="2", debug_level="0")
    _place_functions(tree)
    # Hidden, no table: calls inside the library are direct, those of the interpreter fetch one address and no code.
    for extension in made:
        options = [_CONTRACT_OFF, "-fvisibility=hidden", "-fno-plt"]
        if extension.name.endswith("__mypyc"):  # the one that holds all code; the others are a stub each
            options += ["-include", str(tree / COLD_PATHS)]
        extension.sources = [str(tree / source) for source in extension.sources]
        extension.include_dirs = [str(tree / folder) for folder in extension.include_dirs]
        extension.extra_compile_args = [*extension.extra_compile_args, *options]
    return made


def _place_functions(tree: Path) -> None:
    """Mark, in the generated headers, what a tick calls as hot and what runs at the start as cold.

    The linker puts the hot functions side by side, so that a tick touches few pages and cache lines.
    """
    hot = set((tree / HOT_FUNCTIONS).read_text().split())

    def placed(found: re.Match[str]) -> str:
        if found[1].endswith(_AT_START):
            return f"__attribute__((cold)) {found[0]}"
        called = found[1] in hot or found[1].split("___")[0].partition("_")[2] in _LOOP_MODULES
        return f"__attribute__((hot)) {found[0]}" if called else found[0]

    for header in (tree / "build").glob("__native*.h"):
        header.write_text(_PROTOTYPE.sub(placed, header.read_text()))


def main() -> None:
    """Build the extensions into the folder that is the only argument; the current directory is the copy."""
    from setuptools import setup

    (target,) = sys.argv[1:]
    setup(
        name="timberhand-compiled-tick",
        packages=[],
        py_modules=[],
        ext_modules=extensions(Path()),
        script_args=["build_ext", "--build-lib", target],
    )


if __name__ == "__main__":
    main()
