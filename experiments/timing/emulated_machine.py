"""The emulated machine of the timing testbed.

``python -m experiments.timing.emulated_machine --profile aoro_fc8 --bus crane0=wire:crane0 ...``

Every CAN node of the machine on its buses, around joints that follow their valves (`sim.kinematic`): the traffic of the
whole machine for a fraction of a core.  ``--cycle-us`` is the period of the PLC and the fast pressures.  It prints
``ready``, then once a second a JSON line with its timing.

Exit codes: 0 stopped by SIGTERM or SIGINT; 2 usage; 4 bus.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import signal
import sys
import time
from collections.abc import Mapping

from can_dbc.bus.base import Bus
from can_dbc.bus.factory import open_bus
from can_dbc.frame import Frame
from experiments.timing.bus_observer import Continuity, databases
from machine.loading.profile_file import load_profile
from runtime.errors import LinkError
from sim.kinematic import KinematicMachine
from sim.process.live import TX_QUEUE_FRAMES, LiveMachine

STEP_NS = 2_500_000
PRINT_PERIOD_NS = 1_000_000_000


class EmulatedMachine(LiveMachine):
    """A kinematic machine that reports its timing and lost frames."""

    def __init__(self, machine: KinematicMachine, buses: Mapping[str, Bus], continuity: Continuity) -> None:
        super().__init__(machine, buses)
        self._continuity = continuity
        self._next_print_ns = 0

    def _on_received(self, frames: list[Frame]) -> None:
        for frame in frames:
            self._continuity.add(frame.key, frame.data)

    def _on_step(self, now_ns: int) -> None:
        if now_ns >= self._next_print_ns:
            self._next_print_ns = now_ns + PRINT_PERIOD_NS
            seen = {"gaps": self._continuity.gaps, "damaged": self._continuity.damaged}
            print(json.dumps(self.report() | seen | {"cpu_s": time.process_time()}), flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.timing.emulated_machine", description="A kinematic machine on its CAN buses."
    )
    parser.add_argument("--profile", required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bus", action="append", required=True, metavar="NAME=ADDRESS")
    parser.add_argument("--cycle-us", type=int, default=5000)
    options = parser.parse_args(arguments)
    cycle_ns = 1000 * options.cycle_us
    try:
        profile = load_profile(options.profile)
        machine = KinematicMachine(profile, options.seed, step_ns=min(STEP_NS, cycle_ns), cycle_ns=cycle_ns)
        with contextlib.ExitStack() as stack:
            buses = {}
            for name, _, address in (text.partition("=") for text in options.bus):
                buses[name] = stack.enter_context(open_bus(address, tx_queue=TX_QUEUE_FRAMES, participant="rig"))
            live = EmulatedMachine(machine, buses, Continuity(databases(profile)))
            signal.signal(signal.SIGTERM, live.stop)
            signal.signal(signal.SIGINT, live.stop)
            gc.collect()
            gc.freeze()
            print("ready", flush=True)
            live.run()
    except (LinkError, OSError) as error:
        sys.stderr.write(f"emulated machine: {error}\n")
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main())
