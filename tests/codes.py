"""How tests recognize an error: by its code, never by its sentence."""

from __future__ import annotations

from collections.abc import Callable

from runtime.errors import CodedError


def coded(code: str) -> Callable[[CodedError], bool]:
    """For ``pytest.raises(..., check=coded("profile.unknown-key"))``."""
    return lambda error: error.code == code
