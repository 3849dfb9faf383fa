"""Writes the list of compiled functions that a tick calls: ``python -m hil.tick.hot_functions`` (valgrind, minutes).

The compiler keeps the functions of `host.compiled.extension.HOT_FUNCTIONS` together, apart from those that run at the
start only.  A tick after 5 ms of other work pays for every page of code that it touches.  The list is a hint: a name
that no longer exists is ignored, a function that is missing only lies elsewhere.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from hil.tick import worker
from hil.tick.compare import kept_recordings, need_build
from host.compiled.extension import HOT_FUNCTIONS
from runtime.compiled import source_root

_FUNCTION = re.compile(r"^c?fn=\(\d+\) (CPy(?:Def|Py)_\w+)", re.MULTILINE)


def called(recording: Path, folder: Path) -> set[str]:
    """Find the compiled functions that run in the ticks of a recording, by valgrind's callgrind."""
    out = folder / "callgrind"
    subprocess.run(
        [
            "valgrind",
            "--tool=callgrind",
            f"--callgrind-out-file={out}",
            "--collect-atstart=no",
            "--toggle-collect=CPyDef_step___step*",
            sys.executable,
            worker.__file__,
            "replay",
            str(recording),
        ],
        check=True,
    )
    return set(_FUNCTION.findall(out.read_text()))


def main() -> None:
    """Replay the kept recordings and write the list."""
    need_build()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        functions = set[str]().union(*(called(recording, folder) for recording in kept_recordings(folder)))
    (source_root() / HOT_FUNCTIONS).write_text("".join(f"{function}\n" for function in sorted(functions)))
    print(f"{len(functions)} functions run in a tick")


if __name__ == "__main__":
    main()
