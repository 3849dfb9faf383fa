"""``timberhand hil``: real CAN interfaces for any command, and the control loop on a real-time kernel."""

from __future__ import annotations

import typer

from host.rt_lab.__main__ import rt_lab
from host.vcan_lab.__main__ import CONTEXT, vcan

app = typer.Typer(no_args_is_help=True, help="Hardware in the loop: SocketCAN for any command; a real-time kernel.")
app.command("vcan", context_settings=CONTEXT)(vcan)
app.command("rt-lab")(rt_lab)
