"""The copy of the sources that is compiled: our packages, and the codecs generated from the shipped databases."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path
from typing import Final

from can_dbc.dbc.ahead_of_time import module_source
from can_dbc.dbc.codec import SHIPPED, load
from host.compiled.extension import COLD_PATHS, HOT_FUNCTIONS
from host.compiled.modules import CODECS_MODULE, GENERATOR, MODULES, file_of
from runtime.compiled import PACKAGES

_COPIED: Final = (*PACKAGES, "host/compiled")
HOW: Final = (file_of("host.compiled.extension"), COLD_PATHS, HOT_FUNCTIONS)
"""Files that say how the compiler is called."""


def make_tree(root: Path, tree: Path) -> None:
    """Copy the sources below ``root`` to ``tree``, so that edits during the compilation do no harm; add the codecs."""
    for package in _COPIED:
        for path in (root / package).rglob("*"):
            if path.suffix in (".py", ".h", ".txt"):
                copy = tree / path.relative_to(root)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
    shutil.copyfile(root / "host" / "__init__.py", tree / "host" / "__init__.py")
    codecs = [codec for name in SHIPPED for codec in load(name).messages.values()]
    (tree / file_of(CODECS_MODULE)).write_text(module_source(codecs))


def needed_sources(tree: Path) -> list[Path]:
    """List the source files that determine a build: those of `MODULES`, what they import from our packages, and how.

    The compiler takes types and constants from modules that are imported only.
    """
    sources: dict[Path, None] = dict.fromkeys(HOW)
    waiting = [file_of(module) for module in (*MODULES, GENERATOR)]
    while waiting:
        path = waiting.pop()
        if path in sources:
            continue
        sources[path] = None
        for node in ast.walk(ast.parse((tree / path).read_bytes())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            for name in names:
                module_path = Path(*name.split("."))
                waiting += [
                    p for p in (module_path.with_suffix(".py"), module_path / "__init__.py") if (tree / p).is_file()
                ]
    return sorted(sources)
