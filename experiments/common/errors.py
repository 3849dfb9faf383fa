"""The error of experiments that reaches a person."""

from __future__ import annotations

from runtime.errors import CodedError


class ExperimentError(CodedError, ValueError):
    """An experiment cannot measure, or its saved data cannot be read; the sentence says why."""
