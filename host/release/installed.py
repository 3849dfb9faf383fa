"""Whether the program and the machine files of this computer are what was signed.

An installed release keeps the signed list of its bundle, and by it ``program.sha256`` with every file of the program:
code, shipped profiles and envelopes, DBC, EDS, weights.  A machine's own profile has a signed list beside it
(`host.release.machine_files`).  Without a signer's key there is nothing to compare with, and nothing is found wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from host.release import machine_files, sums
from host.release.bundle import PROGRAM_SUMS, SUMS
from host.release.signature import verify
from host.release.trees import RELEASES, marker_of
from runtime.errors import Problem, TimberhandError

PROGRAM: Final = Path(__file__).resolve().parents[2]
"""The folder of this program's packages: site-packages of a release, or a checkout."""
_BELOW: Final = ("lib", "site-packages")
"""Where they lie in the tree of a release: lib/python3.11/site-packages."""


def tree_of(program: Path) -> Path | None:
    """Find the tree of the release that a program belongs to; None for a checkout or another environment."""
    if (program.parent.parent.name, program.name) != _BELOW:
        return None
    tree = program.parent.parent.parent
    return tree if tree.parent.name == RELEASES and marker_of(tree) else None


def problems(signer: Path, profile: Path, program: Path = PROGRAM) -> Iterator[Problem]:
    """Report what is not as it was signed, with codes; nothing without the signer's key or outside an installation."""
    tree = tree_of(program)
    if not signer.is_file() or tree is None:
        return
    yield from _program(tree, program, signer)
    if not profile.resolve().is_relative_to(program):
        try:
            machine_files.check(profile.parent, signer)
        except TimberhandError as error:
            yield Problem(error.code, str(error))


def _program(tree: Path, program: Path, signer: Path) -> Iterator[Problem]:
    listed = tree / SUMS
    if not listed.is_file():
        yield Problem(
            "installed.unsigned", f"the release {tree.name} came without a signature; update to a signed bundle"
        )
        return
    try:
        verify(listed, signer)
        sums_digest = sums.decode(listed.read_text(), str(listed)).get(PROGRAM_SUMS)
        if sums_digest is None or sums.differing(tree, {PROGRAM_SUMS: sums_digest}):
            changed = [PROGRAM_SUMS]
        else:
            changed = sums.differing(program, sums.decode((tree / PROGRAM_SUMS).read_text(), str(tree / PROGRAM_SUMS)))
    except TimberhandError as error:
        yield Problem(error.code, str(error))
        return
    if changed:
        rest = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        yield Problem(
            "installed.changed",
            f"{changed[0]}{rest} of the release {tree.name} is not what was signed; update to its bundle again, or "
            "roll back",
        )
