"""The compiled tick of the present sources, for the tests that compare it with the interpreter."""

from __future__ import annotations

import pytest

from host.compiled.build import check_tools, compile_tick
from host.exit_codes import CommandFailed


def build_key() -> str:
    """Return the key of the build; compile when there is none, skip where there is no compiler."""
    try:
        check_tools()
    except CommandFailed as missing:
        pytest.skip(str(missing))
    return str(compile_tick(print)["key"])
