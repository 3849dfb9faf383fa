"""``timberhand hil``: real CAN interfaces for any command."""

from __future__ import annotations

import typer

from host.vcan_lab.__main__ import CONTEXT, vcan

app = typer.Typer(no_args_is_help=True, help="Hardware in the loop: run any command with SocketCAN interfaces.")
app.command("vcan", context_settings=CONTEXT)(vcan)


@app.callback()
def group() -> None:
    """Keep ``vcan`` a subcommand although it is the only one."""
