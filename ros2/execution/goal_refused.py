"""Why a goal is not executed."""

from __future__ import annotations

from runtime.errors import TimberhandError


class GoalRefused(TimberhandError, ValueError):
    """A goal that is not executed; ``error_code`` is that of its result (`ros2.interfaces.control.ErrorCode`)."""

    def __init__(self, code: str, sentence: str, error_code: int) -> None:
        super().__init__(code, sentence)
        self.error_code = error_code
