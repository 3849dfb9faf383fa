"""A crane on the bench without a planner: wire, plant, guard, controller and console, as processes in real time."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

from can_dbc.messages.envelope import write_key
from hil.harness.live import HARDWARE_PRIORITY
from hil.harness.processes import ProcessGroup, free_udp_ports
from hil.wire.core import BITRATES
from tests.live.console.entries import note

START_S = 60.0


@contextlib.contextmanager
def bench(folder: Path, profile: str = "palms_471") -> Iterator[str]:
    """The address of its page; ``folder`` gets what the processes write."""
    (folder / "wire").mkdir()
    group = ProcessGroup(folder, environment={"TIMBERHAND_WIRE_DIR": str(folder / "wire")})
    setpoints, reports, sim = free_udp_ports(3)
    named, bus = ("--profile", profile), ("--bus", "crane0=wire:crane0")
    operator, keyed = folder / "operator", ("--key-file", write_key(folder / "key"))
    try:
        group.start("wire", "hil.wire.daemon", "--bus", f"crane0:{BITRATES['crane0']}")
        group.await_message("wire", "ready", START_S)
        group.start("sim", "sim", *named, "--seed", 1, "--truth", "nominal", "--port", sim, *bus)
        group.await_message("sim", "ready", START_S)
        for name, priority in HARDWARE_PRIORITY.items():
            group.set_fifo_priority(name, priority)
        ends = ("--port", 0, "--report-port", reports, "--controller", f"127.0.0.1:{setpoints}")
        files = ("--operator", operator, "--commission", folder / "kept", "--audit", folder / "audit.jsonl")
        group.start("console", "console", *named, *bus, *ends, *files, *keyed)
        url = note(str(group.await_message("console", "url", START_S)["url"]))
        group.start("guard", "controller.guard", *named, *bus, "--operator", operator, "--state", folder / "latched")
        ends = ("--setpoint-port", setpoints, "--report", f"127.0.0.1:{reports}")
        files = ("--operator", operator, "--timing", folder / "timing")
        group.start("controller", "controller", *named, *bus, *ends, *files, *keyed)
        yield url
    finally:
        group.stop_all(("controller", "guard", "console", "sim", "wire"))


def audited(folder: Path) -> list[str]:
    """What was commanded on its page and done."""
    lines = map(json.loads, (folder / "audit.jsonl").read_text().splitlines())
    return [line["what"] for line in lines if line["result"] < 400]
