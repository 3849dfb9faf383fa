"""The error of a run that cannot be set up."""

from __future__ import annotations

from runtime.errors import CodedError


class SetupError(CodedError, ValueError):
    """Machine, scene, mission or detector cannot be used for the requested run."""
