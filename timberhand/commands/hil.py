"""``timberhand hil``: hardware-in-the-loop helpers."""

from __future__ import annotations

import typer

from host.vcan_lab.__main__ import CONTEXT, vcan

app = typer.Typer(no_args_is_help=True, help="Hardware in the loop: real CAN interfaces for any command.")
app.command("vcan", context_settings=CONTEXT)(vcan)


@app.callback()
def group() -> None:
    """Keeps ``vcan`` a subcommand while it is the only one."""
