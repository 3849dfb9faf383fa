"""How tests recognize an error: by its code, never by its sentence, and the numbers that a sentence alone carries."""

from __future__ import annotations

import re
from collections.abc import Callable

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import TimberhandError


def coded(code: str) -> Callable[[TimberhandError], bool]:
    """For ``pytest.raises(..., check=coded("profile.unknown-key"))``."""
    return lambda error: error.code == code


def exit_code_of(error: TimberhandError) -> ExitCode:
    """The exit code with which ``timberhand`` ends for an error that reaches its command line."""
    return error.exit_code if isinstance(error, CommandFailed) else ExitCode.CONFIGURATION


def numbers_in(text: str) -> list[float]:
    """The numbers of a text in their order, where it alone carries them; its words are not compared."""
    return [float(number) for number in re.findall(r"(?<!\w)(?<!\d\.)-?\d+(?:\.\d+)?", text)]
