"""Why the console cannot start."""

from __future__ import annotations

from typing import Any

from runtime.errors import TimberhandError


class StartError(TimberhandError):
    """The console cannot start: an error code, one sentence and the exit code of the process."""

    def __init__(self, code: str, sentence: str, exit_code: int) -> None:
        super().__init__(code, sentence)
        self.exit_code = exit_code

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.code, str(self), self.exit_code)
