"""A live view of the plant: the plant on the wire with its three-dimensional page, until interrupted.

A controller may join the bus; without one the page's hand levers move the machine.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rich.console import Console

from hil.harness.live import HOST, START_S
from hil.harness.processes import ProcessGroup, free_udp_ports
from hil.wire.core import BITRATES
from host.exit_codes import CommandFailed, ExitCode
from machine.profile import Profile

END_ORDER: Final = ("console", "sim", "wire")


def run_view(
    profile: Profile, profile_name: str, plant_options: Sequence[str], page_port: int, directory: Path, screen: Console
) -> None:
    """Start wire, plant and page, print their addresses, and wait for Ctrl-C.

    Raises:
        CommandFailed: a process cannot start or dies.
        KeyboardInterrupt: interrupted; every process has ended.
    """
    processes = ProcessGroup(directory)
    try:
        buses = [b for b in (profile.crane_bus, profile.machine_bus) if b]
        (port,) = free_udp_ports(1)
        processes.start("wire", "hil.wire.daemon", *(x for b in buses for x in ("--bus", f"{b}:{BITRATES[b]}")))
        processes.await_message("wire", "ready", START_S)
        on_bus = [x for b in buses for x in ("--bus", f"{b}=wire:{b}")]
        processes.start("sim", "sim", "--profile", profile_name, *on_bus, "--port", port, *plant_options)
        processes.await_message("sim", "ready", START_S)
        processes.start("console", "console", "--plant", f"{HOST}:{port}", "--port", page_port)
        url = processes.await_message("console", "url", START_S)["url"]
        screen.print(f"view: [bold]{url}[/bold]; Ctrl-C ends it")
        screen.print(f"buses: {', '.join(f'wire:{b}' for b in buses)}", style="dim")
        while (gone := processes.dead()) is None:
            processes.messages()
            time.sleep(0.1)
        raise CommandFailed(
            "live.process-ended", f"the {gone.name} process ended: {gone.complaint()}", ExitCode.CONFIGURATION
        )
    finally:
        processes.stop_all(END_ORDER)
