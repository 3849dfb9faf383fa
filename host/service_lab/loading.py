"""One log from the ground into the bunk by the installed services alone, in simulated time.

A person opens the printed address, takes the lease, and presses RESET and ARM; nobody types anything at the planner's
side.  The camera is the plant's: its service asks for pictures, the planner asks that service for logs.
"""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from typing import Any, Final

from host.service_lab import authority
from host.systemd import journal, show

PLANNER: Final = "timberhand-autonomy.service"
LOAD_S: Final = 300.0
"""A log takes half a minute; the planner looks for it as soon as the camera's service answers."""
SETTLE_S: Final = 20.0
Expect = Callable[[object, str], None]
Step = Callable[[str], None]


def load_a_log(page: str, plant_port: int, expect: Expect, step: Step) -> dict[str, float]:
    """Arm the machine on the page and wait for the planner's end; returns the seconds that it took.

    The planner is `active` until its mission has ended; that the log lies in the bunk is the plant's word.
    """
    origin = page.rstrip("/")
    token = authority.open_page(origin)
    for path, body in (("lease/take", {"over": 0}), ("operator/reset", None), ("operator/arm", None)):
        code, text = authority.post(origin, path, token, body)
        expect(code in (200, 204), f"{path} was answered {code}: {text}")
        time.sleep(1.0)
    begin_s = time.monotonic()
    while show(PLANNER, "ActiveState")["ActiveState"] == "active" and time.monotonic() < begin_s + LOAD_S:
        time.sleep(1.0)
    loaded_s = time.monotonic() - begin_s
    for line in journal(PLANNER):
        if '"event"' in line:
            step(f"planner: {line}")
    expect(show(PLANNER, "Result")["Result"] == "success", f"the planner: {journal(PLANNER)[-8:]}")
    while (
        not (verdict := ask_plant(plant_port, "verdict"))["success"] and time.monotonic() < begin_s + LOAD_S + SETTLE_S
    ):
        time.sleep(1.0)
    expect(verdict["success"], f"the log is not in the bunk: {verdict}")
    return {"loaded_s": loaded_s}


def ask_plant(port: int, question: str) -> dict[str, Any]:
    """Ask the emulated machine (``python -m sim``); return its answer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.sendto(json.dumps({"op": question}).encode(), ("127.0.0.1", port))
        answer: dict[str, Any] = json.loads(client.recv(65536))
        return answer
