"""Who may command under systemd: the page as an operator with its token and lease, nobody as the planner.

`load_a_log` is what it commands in earnest: one log from the ground into the bunk by the installed services alone, in
simulated time.  A person opens the printed address, takes the lease, and presses RESET and ARM; nobody types anything
at the planner's side.  The camera is the plant's: its service asks for pictures, and the planner asks it for logs.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Final

from host.service_lab import trial
from host.service_lab.updates import Expect, Step
from host.systemd import journal, show

AUTHORITY_S: Final = 10.0
TOKEN_HEADER: Final = "X-Timberhand-Page"
"""The page's token in a request; this test knows it as a foreign client would."""
_ENTERED: Final = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
"""Keeps the cookie of the session, as a browser."""
OPERATORS: Final = Path("/run/timberhand-operator/controller")
PLANNER: Final = "timberhand-autonomy.service"
LOAD_S: Final = 300.0
"""A log takes half a minute; the planner looks for it as soon as the camera's service answers."""
SETTLE_S: Final = 20.0


def probe(expect: Expect, page: str) -> None:
    """Check: the page commands for who opened the printed address alone, and the planner's user sees no socket."""
    origin = page.rstrip("/")
    _, session = post(origin, "session")
    answer = json.loads(session)
    expect(answer["token"] == "", f"who has not opened the printed address got the page {answer['page']}")
    token = open_page(origin)
    unnamed, _ = post(origin, "operator/reset")
    expect(unnamed == 403, f"a reset that no page sends was answered {unnamed}")
    for action, mode in (("stop", "STOP. "), ("reset", "STANDBY. ")):
        if action != "stop":
            post(origin, "lease/take", token, {"over": 0})
        code, answer = post(origin, f"operator/{action}", token)
        expect(code == 204, f"the page's {action} was answered {code}: {answer}")
        limit = time.monotonic() + AUTHORITY_S
        while not (status := show(trial.CONTROLLER, "StatusText")["StatusText"]).startswith(mode):
            if time.monotonic() > limit:
                expect(False, f"after the page's {action} the controller's status is {status!r}")
                break
            time.sleep(0.2)
    send = f"import socket; socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b'x', '{OPERATORS}')"
    command = ("setpriv", "--reuid", "timberhand-planner", "--regid", "timberhand-planner", "--init-groups")
    done = subprocess.run([*command, sys.executable, "-c", send], capture_output=True, text=True)
    expect("PermissionError" in done.stderr, f"the planner's user sent a command: {done.stderr[-300:]}")


def load_a_log(page: str, plant_port: int, expect: Expect, step: Step) -> dict[str, float]:
    """Arm the machine on the page and wait for the planner's end; returns the seconds that it took.

    The planner is `active` until its mission has ended; that the log lies in the bunk is the plant's word.
    """
    origin = page.rstrip("/")
    token = open_page(origin)
    for path, body in (("lease/take", {"over": 0}), ("operator/reset", None), ("operator/arm", None)):
        code, text = post(origin, path, token, body)
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
    while not (verdict := trial.ask_plant(plant_port, "verdict"))["success"]:
        if time.monotonic() > begin_s + LOAD_S + SETTLE_S:
            break
        time.sleep(1.0)
    expect(verdict["success"], f"the log is not in the bunk: {verdict}")
    return {"loaded_s": loaded_s}


def open_page(origin: str) -> str:
    """Open the address that the console printed, as a person does; returns the page's token."""
    _ENTERED.open(printed_address(), timeout=10.0).close()
    _, session = post(origin, "session")
    token: str = json.loads(session)["token"]
    return token


def printed_address() -> str:
    """Find the page's address with its token, in the console's journal of its present start."""
    return next(str(json.loads(line)["url"]) for line in reversed(journal("timberhand-console")) if '"url"' in line)


def post(origin: str, path: str, token: str = "", body: object = None) -> tuple[int, str]:
    """Send a command to the page; return status and text of its answer."""
    headers = {"Origin": origin, "Content-Type": "application/json"} | ({TOKEN_HEADER: token} if token else {})
    data = b"" if body is None else json.dumps(body).encode()
    request = urllib.request.Request(f"{origin}/api/{path}", data, headers, method="POST")
    try:
        with _ENTERED.open(request, timeout=10.0) as answer:  # the page of this lab, http  # nosec B310
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
