"""The error of data sets that cannot be read."""

from __future__ import annotations

from runtime.errors import CodedError


class DatasetError(CodedError, ValueError):
    """A folder or file that is not a data set in the expected layout."""
