"""The exit codes of every command, and the exception that ends a command with one sentence and an exit code."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Self

from runtime.errors import TimberhandError


class ExitCode(IntEnum):
    """The exit codes of every command and process (``timberhand --help``)."""

    OK = 0
    USAGE = 2
    CONFIGURATION = 3
    BUS = 4
    SAFETY_STOP = 5
    FIGURE_MISSED = 6
    INTERRUPTED = 130

    @property
    def words(self) -> str:
        """The name in words, as shown beside the number."""
        return self.name.lower().replace("_", " ")


class CommandFailed(TimberhandError):
    """Ends a command: an error code, one sentence for stderr, and the exit code, by default that of any coded error."""

    def __init__(self, code: str, sentence: str, exit_code: ExitCode = ExitCode.CONFIGURATION) -> None:
        super().__init__(code, sentence)
        self.exit_code = exit_code

    @classmethod
    def from_error(cls, error: Exception, exit_code: ExitCode = ExitCode.CONFIGURATION) -> Self:
        """Make a failure with the same sentence, and the same error code where ``error`` carries one."""
        return cls(error.code if isinstance(error, TimberhandError) else "", str(error), exit_code)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.code, str(self), self.exit_code)
