"""Updates inside the guest: one that is refused, one that stays, and one that is cut off and comes back by itself."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from host.exit_codes import ExitCode
from host.release.gate import lacking
from host.release.services import CONTROLLER, RESUME, SystemdServices
from host.release.trees import State, Trees
from host.release.updater import PLACE, SIGNER
from host.systemd import journal, show, systemctl

COMMAND: Final = "/usr/local/bin/timberhand"
FAILURES: Final = Path("/var/lib/timberhand-failures/failures.jsonl")
SWITCH_S: Final = 400.0
"""A release is installed and compiled in a guest that shares a processor with everything else."""
RETURN_S: Final = 240.0
SETTLE_S: Final = 120.0
"""Page and planner start, too, and take a minute for their imports; frames come late until then."""
Expect = Callable[[object, str], None]
Step = Callable[[str], None]
Machine = subprocess.Popen[str]


def try_updates(order: dict[str, str], machine: Machine, expect: Expect, step: Step) -> dict[str, Any]:
    """Try all three; return the times they took [s].

    The machine is off until the new release starts: emulating it would take half of the guest's only processor.
    """
    shutil.copy(order["signer"], SIGNER)
    figures = {"refused_s": _refused(order, expect)}
    step(f"update, refused: {figures['refused_s']:.1f} s")
    figures["stays_s"] = _good(order, machine, expect)
    step(f"update: {figures['stays_s']:.1f} s")
    figures["return_s"] = _cut_off(order, machine, expect)
    step(f"update cut off, and back: {figures['return_s']:.1f} s")
    return figures


def _update(bundle: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([COMMAND, "service", "update", bundle], capture_output=True, text=True, check=False)


def _refused(order: dict[str, str], expect: Expect) -> float:
    """Try a bundle with one changed byte."""
    begin_s = time.monotonic()
    before = Trees(PLACE).state()
    with tempfile.NamedTemporaryFile(suffix=".tar") as file:
        shutil.copy(order["bundle"], file.name)
        file.seek(700)
        file.write(b"?")
        file.flush()
        done = _update(file.name)
    expect(done.returncode == ExitCode.CONFIGURATION, f"a changed bundle ended with {done.returncode}: {done.stderr}")
    expect(Trees(PLACE).state() == before, "a changed bundle changed the release")
    return time.monotonic() - begin_s


def _begin_update(bundle: str, machine: Machine) -> subprocess.Popen[str]:
    """Start an update; returns when it has changed the release, or has ended."""
    state_before = Trees(PLACE).state()
    limit_s = time.monotonic() + SWITCH_S
    machine.send_signal(signal.SIGSTOP)
    try:
        update = subprocess.Popen([COMMAND, "service", "update", bundle], stderr=subprocess.PIPE, text=True)
        while (state := Trees(PLACE).state()) == state_before or state.trial == state.current:
            if update.poll() is not None or time.monotonic() > limit_s:
                break
            time.sleep(0.1)
    finally:
        machine.send_signal(signal.SIGCONT)
    return update


def _good(order: dict[str, str], machine: Machine, expect: Expect) -> float:
    """Check that a release that works stays, with the former one behind it."""
    begin_s = time.monotonic()
    former = Trees(PLACE).state().current
    update = _begin_update(order["bundle"], machine)
    _, error_text = update.communicate()
    expect(update.returncode == 0, f"the update ended with {update.returncode}: {error_text[-1500:]}")
    state = Trees(PLACE).state()
    release_name = Path(order["bundle"]).name.removeprefix("timberhand-").removesuffix(".tar")
    expect(state.current == release_name, f"after the update {state.current} is in use")
    expect(state == State(state.current, former, None), f"after the update the links are {state}")
    expect(not (missing := _lacking(SETTLE_S)), f"after the update {missing}")
    return time.monotonic() - begin_s


def _cut_off(order: dict[str, str], machine: Machine, expect: Expect) -> float:
    """Try a release that does not come up; kill the update while it waits at the gate, and start the target again."""
    state_before = Trees(PLACE).state()
    update = _begin_update(order["broken"], machine)
    state = Trees(PLACE).state()
    update.send_signal(signal.SIGKILL)
    _, error_text = update.communicate()
    expect(state.trial == state_before.current, f"the update has not changed the release: {state}, {error_text}")
    begin_s = time.monotonic()
    systemctl("stop", "timberhand.target")
    systemctl("--no-block", "start", "timberhand.target")  # as the computer's start does
    while time.monotonic() < begin_s + RETURN_S:
        if Trees(PLACE).state() == state_before and not _lacking():
            break
        time.sleep(0.5)
    took_s = time.monotonic() - begin_s
    expect(
        Trees(PLACE).state() == state_before, f"it does not come back: {Trees(PLACE).state()}, {journal(RESUME)[-12:]}"
    )
    expect(not (missing := _lacking(SETTLE_S)), f"it came back, and {missing}: {journal(RESUME)[-12:]}")
    limit_s = time.monotonic() + SWITCH_S
    while show(RESUME, "ActiveState")["ActiveState"] == "activating" and time.monotonic() < limit_s:
        time.sleep(0.2)
    ended = show(RESUME, "ActiveState", "ExecMainStatus")
    expected_ending = {"ActiveState": "inactive", "ExecMainStatus": str(int(ExitCode.FIGURE_MISSED))}
    expect(ended == expected_ending, f"{RESUME} ended with {ended}: {journal(RESUME)[-12:]}")
    failures = [json.loads(line) for line in FAILURES.read_text().splitlines()] if FAILURES.is_file() else []
    failed = [(failure["unit"], failure["result"], failure["status"]) for failure in failures]
    expect((CONTROLLER, "exit-code", "1") in failed, f"no record of the controller that failed: {failed}")
    return took_s


def _lacking(within_s: float = 0.0) -> str:
    """Say what a release lacks, and still does after so long: a stall of the lab makes commands late for a moment."""
    limit_s = time.monotonic() + within_s
    while missing := lacking(*SystemdServices(PLACE / "current/deploy/units").readings()):
        if time.monotonic() > limit_s:
            break
        time.sleep(0.5)
    return missing
