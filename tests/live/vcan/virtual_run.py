"""One run in simulated time, inside the lab: the real controller and guard, light emulated nodes, candump, a pilot.

``python virtual_run.py DIRECTORY`` (root, for the interface) leaves there ``vcan0.log`` of candump, ``page.json`` with
the moments at which something was done, and what each process said.  ``python virtual_run.py --nodes`` is the machine's
nodes around joints that follow their valves; SIGUSR1 presses the emergency stop, SIGUSR2 lets it go and resets the box.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from can_dbc.bus.factory import open_bus
from can_dbc.messages.crane import OperatorAction
from can_dbc.messages.envelope import read_key, write_key
from host.service_lab.pilot import PERIOD_NS, Pilot
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode

PROFILE = "palms_471"
BUS = "socketcan:vcan0"
SETPOINTS, REPORTS = 24701, 24702
TIMEOUT_S = 30.0


def nodes() -> None:
    """The machine's nodes, until SIGTERM."""
    from sim.kinematic import KinematicMachine
    from sim.process.live import TX_QUEUE_FRAMES, LiveMachine

    machine = KinematicMachine(load_profile(PROFILE), seed=1, step_ns=2_500_000)
    with open_bus(BUS, tx_queue=TX_QUEUE_FRAMES) as bus:
        live = LiveMachine(machine, {"crane0": bus})
        signal.signal(signal.SIGUSR1, lambda *_: machine.estop.press())
        signal.signal(signal.SIGUSR2, lambda *_: (machine.estop.release(), machine.estop.reset()))
        signal.signal(signal.SIGTERM, live.stop)
        print("ready", flush=True)
        live.run()


class Run:
    """The processes of one run and the page that is written about it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.page: dict[str, int] = {}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        # "any": a socket bound to one interface hears of its end, and candump then ends.
        self.start("candump", "candump", "-L", "any", out="vcan0.log")
        self.start("nodes", sys.executable, __file__, "--nodes")
        while "ready" not in (directory / "nodes.out").read_text():
            time.sleep(0.01)
        bus = ("--profile", PROFILE, "--bus", f"crane0={BUS}")
        heard = ("--operator", str(directory / "operator"), "--state", str(directory / "latched"))
        self.start("guard", sys.executable, "-m", "controller.guard", *bus, *heard)
        key_file = write_key(directory / "key")
        self.pilot = Pilot(PROFILE, SETPOINTS, directory / "operator", REPORTS, BUS, read_key(key_file))
        links = ("--setpoint-port", str(SETPOINTS), "--report", f"127.0.0.1:{REPORTS}", *heard[:2])
        files = ("--timing", str(directory / "timing"), "--key-file", str(key_file))
        self.start("controller", sys.executable, "-m", "controller", *bus, *links, *files)

    def start(self, name: str, *command: str, out: str = "") -> None:
        """Start a process; what it says goes into files."""
        streams = [open(self.directory / file, "wb") for file in (out or f"{name}.out", f"{name}.err")]  # noqa: SIM115
        self.processes[name] = subprocess.Popen(command, stdout=streams[0], stderr=streams[1])
        for stream in streams:
            stream.close()

    def mark(self, name: str) -> None:
        """Write down that something is done now."""
        self.page[name] = time.monotonic_ns()

    def tell(self, process: str, number: signal.Signals, mark: str) -> None:
        """Send a signal."""
        self.mark(mark)
        self.processes[process].send_signal(number)

    def link(self, state: str, mark: str) -> None:
        """Take the interface up or down."""
        self.mark(mark)
        subprocess.run(["ip", "link", "set", "vcan0", state], check=True)

    def mode(self) -> Mode | None:
        return Mode(self.pilot.report.mode) if self.pilot.report else None

    def until(self, mode: Mode) -> None:
        assert self.pilot.until(lambda: self.mode() is mode, TIMEOUT_S), f"no {mode.name}: {self.pilot.report}"

    def wait(self, seconds: float) -> None:
        self.pilot.until(lambda: False, seconds)

    def swing(self) -> None:
        """Bring the crane into motion from whatever mode, as a human and a planner would."""
        if self.mode() is Mode.FAULT:
            self.pilot.press(OperatorAction.RESET)
        assert self.pilot.until(lambda: self.mode() in (Mode.STANDBY, Mode.STOP), TIMEOUT_S), self.pilot.report
        self.wait(0.3)
        self.pilot.press(OperatorAction.ARM)
        self.until(Mode.ARMED)
        self.pilot.swing()
        self.until(Mode.ACTIVE)
        self.wait(1.5)
        assert self.mode() is Mode.ACTIVE, self.pilot.report

    def finish(self) -> None:
        """End everything and write the page."""
        for name in ("controller", "guard", "nodes", "candump"):
            self.processes[name].terminate()
            self.page[f"{name}_status"] = self.processes[name].wait()
        (self.directory / "page.json").write_text(json.dumps(self.page, indent=1))


def main(directory: Path) -> None:
    """The story of the run."""
    run = Run(directory)
    run.until(Mode.STANDBY)
    run.swing()
    run.page["setpoint"] = run.pilot._next_ns - PERIOD_NS
    run.pilot.rest()  # the lease ends
    run.until(Mode.STOP)
    run.wait(1.0)

    for process, begins, ends, marks, pause_s in (
        ("nodes", signal.SIGUSR1, signal.SIGUSR2, ("estop", "released"), 0.2),
        ("controller", signal.SIGSTOP, signal.SIGCONT, ("frozen", "thawed"), 0.5),
    ):
        run.swing()
        run.tell(process, begins, marks[0])
        run.wait(0.5)
        run.pilot.rest()
        run.tell(process, ends, marks[1])
        run.wait(pause_s)

    run.swing()
    run.tell("guard", signal.SIGKILL, "guard_killed")
    run.wait(0.5)
    run.pilot.rest()
    run.start("guard", *run.processes["guard"].args)  # type: ignore[misc]
    run.wait(0.5)

    run.swing()
    run.link("down", "down")
    run.wait(0.1)
    run.link("up", "up")
    run.wait(0.5)
    run.pilot.rest()
    run.link("down", "down_long")
    run.wait(1.0)  # long enough to be opened anew
    run.link("up", "up_long")
    run.wait(1.0)
    run.swing()
    run.finish()


if __name__ == "__main__":
    if sys.argv[1:] == ["--nodes"]:
        nodes()
    else:
        os.chdir(Path(__file__).parents[3])
        main(Path(sys.argv[1]))
