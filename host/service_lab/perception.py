"""The camera's service inside the guest: it sees a log, comes back when killed or hung, and bears a lost camera.

``python -m host.service_lab.perception PORT`` is the camera: the server of the plant's pictures, of a plant that is not
stepped, so that drawing takes no time from the one on the buses.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from host.service_lab.updates import Expect, Step
from host.systemd import journal, main_pid, show

UNIT: Final = "timberhand-perception.service"
OTHERS: Final = ("timberhand-controller.service", "timberhand-guard.service")
PROFILE: Final = "palms_471"
SEEN_S: Final = 60.0
"""A detection takes a second; the planner asks four times a second, and the start of both takes most of a minute."""
BACK_S: Final = 60.0


def try_perception(port: int, expect: Expect, step: Step) -> dict[str, float]:
    """Try all of it; return the times it took [s].  Controller and guard must not notice."""
    before = [show(unit, "MainPID", "NRestarts") for unit in OTHERS]
    figures: dict[str, float] = {}
    camera = start_camera(port)
    try:
        figures["seen_s"] = _until(sees, SEEN_S, expect, "it sees no log")
        step(f"perception: {words()}")
        for name, number in (("kill", signal.SIGKILL), ("hang", signal.SIGSTOP)):
            restarts, pid = int(show(UNIT, "NRestarts")["NRestarts"]), main_pid(UNIT)
            os.kill(pid, number)
            figures[f"{name}_back_s"] = _until(partial(_is_another, pid), BACK_S, expect, f"{name}: it is not back")
            after = int(show(UNIT, "NRestarts")["NRestarts"])
            expect(after == restarts + 1, f"{name}: {after - restarts} restarts")
            step(f"perception, {name}: back after {figures[f'{name}_back_s']:.1f} s")
        watchdog = [line for line in journal(UNIT) if "Watchdog timeout" in line]
        expect(watchdog, f"systemd says nothing of a watchdog of {UNIT}")
        pid = main_pid(UNIT)
        camera.kill()
        camera.wait()
        figures["pulled_told_s"] = _until(lambda: words().startswith("No logs: "), BACK_S, expect, "no word of it")
        camera = start_camera(port)
        figures["pulled_back_s"] = _until(sees, SEEN_S, expect, "the camera is back, and it sees no log")
        expect(main_pid(UNIT) == pid, "it ended with its camera")
    finally:
        camera.kill()
        camera.wait()
    others = [show(unit, "MainPID", "NRestarts") for unit in OTHERS]
    expect(others == before, f"controller or guard restarted: {before}, {others}")
    return figures


def start_camera(port: int) -> subprocess.Popen[bytes]:
    """Start the camera as a process of its own."""
    environment = os.environ | {"PYTHONPATH": ":".join(sys.path[1:])}
    return subprocess.Popen([sys.executable, "-m", "host.service_lab.perception", str(port)], env=environment)


def words() -> str:
    """Return the service's status line."""
    return show(UNIT, "StatusText").get("StatusText", "")


def sees() -> bool:
    """Tell whether it reports a log."""
    return "1 logs" in words()


def _is_another(pid: int) -> bool:
    return main_pid(UNIT) not in (0, pid) and sees()


def _until(reached: Callable[[], Any], limit_s: float, expect: Expect, sentence: str) -> float:
    begin_s = time.monotonic()
    while not (outcome := reached()) and time.monotonic() < begin_s + limit_s:
        time.sleep(0.5)
    expect(outcome, f"perception: {sentence}: {words()!r}, {journal(UNIT)[-8:]}")
    return time.monotonic() - begin_s


def main() -> None:
    """Run the camera, until it is killed."""
    from machine.loading.profile_file import load_profile
    from sim.camera.rig import CameraRig
    from sim.camera.server import CameraServer
    from sim.plant import Plant

    plant = Plant(load_profile(PROFILE))
    server = CameraServer(CameraRig(plant.world, plant.profile, plant.world.truth, 0), int(sys.argv[1]))
    while True:
        server.serve(time.monotonic_ns())
        time.sleep(0.01)


if __name__ == "__main__":
    main()
