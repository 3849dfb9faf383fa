"""A plant to look at: the live plant on the wire with its three-dimensional page, until interrupted.

Any controller may join on the bus meanwhile; without one the page's hand levers move the machine.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

from hil.live import BITRATES, HOST, START_S
from hil.processes import Family, free_udp_ports
from host.exits import Exit, Stopped
from machine.profile import Profile

END_ORDER: Final = ("console", "sim", "wire")


def run_view(
    profile: Profile, profile_name: str, plant_options: Sequence[str], page_port: int, directory: Path, screen: Console
) -> None:
    """Start wire, plant and page, say where they are, and wait for Ctrl-C.

    Raises:
        Stopped: when a process cannot start or dies.
        KeyboardInterrupt: when asked to end, after everything has ended.
    """
    family = Family(directory)
    try:
        buses = [b for b in (profile.crane_bus, profile.machine_bus) if b]
        (port,) = free_udp_ports(1)
        family.start("wire", "hil.wire.daemon", *(x for b in buses for x in ("--bus", f"{b}:{BITRATES[b]}")))
        family.await_message("wire", "ready", START_S)
        on_bus = [x for b in buses for x in ("--bus", f"{b}=wire:{b}")]
        family.start("sim", "sim", "--profile", profile_name, *on_bus, "--port", port, *plant_options)
        family.await_message("sim", "ready", START_S)
        family.start("console", "console", "--plant", f"{HOST}:{port}", "--port", page_port)
        url = family.await_message("console", "url", START_S)["url"]
        screen.print(f"look at [bold]{url}[/bold]; Ctrl-C ends it")
        screen.print(f"buses to join: {', '.join(f'wire:{b}' for b in buses)}", style="dim")
        while (gone := family.dead()) is None:
            family.messages()
            time.sleep(0.1)
        raise Stopped(Exit.CONFIGURATION, f"the {gone.name} process ended: {gone.complaint()}")
    finally:
        family.stop_all(END_ORDER)
