"""``python3.11 timberhand-VERSION.whl/deploy [options]``: run `install.sh` from the wheel alone.

Requires only Python; nothing must be unpacked or installed before.  ``python3.11 -m deploy`` does the same with a
checkout or an installed wheel.  Options and exit status are those of the script.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve().parent
SCRIPT: Final = "install.sh"


def install(options: Sequence[str]) -> int:
    """Run the script; from a wheel it installs that wheel unless ``options`` name another one or a bundle."""
    wheel = next((folder for folder in HERE.parents if folder.is_file()), None)
    if wheel is None:
        return subprocess.call(["sh", str(HERE / SCRIPT), *options])
    with tempfile.TemporaryDirectory(prefix="timberhand-") as folder, zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder, [name for name in archive.namelist() if name.startswith("deploy/")])
        own = () if "--bundle" in options else ("--wheel", str(wheel))
        return subprocess.call(["sh", f"{folder}/deploy/{SCRIPT}", *own, *options])


if __name__ == "__main__":
    sys.exit(install(sys.argv[1:]))
