"""Sealed seeds: drawn from the commit that is measured, so that nobody can have tuned on them.

The rule is part of the commit, and its hash is not known before the commit is made: each change of the code brings
other trials, and anyone with the checkout can draw the same.
"""

from __future__ import annotations

import hashlib
from typing import Final

FIRST: Final = 100_000
COUNT: Final = 900_000
"""Sealed seeds are FIRST to FIRST + COUNT - 1; tuning and validation use smaller ones."""


def sealed_seed(commit: str, experiment: str) -> int:
    """The seed of an experiment at a commit."""
    digest = hashlib.sha256(f"{commit}/{experiment}".encode()).digest()
    return FIRST + int.from_bytes(digest[:8], "big") % COUNT
