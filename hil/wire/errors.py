"""The error of a wire bus that is used wrongly."""

from __future__ import annotations

from runtime.errors import CodedError


class WireError(CodedError, ValueError):
    """A bit rate, a time or a fault that the wire cannot have."""
