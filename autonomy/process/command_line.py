"""Command line of the planning process."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Final

import msgspec

from autonomy.grasp.planners import NAMES, SEARCH, PlannerChoice
from autonomy.manager.transition_table import TABLES
from can_dbc.messages.udp_address import address_argument, local_address_argument
from runtime.errors import InputRefused

Address = tuple[str, int]


def arguments(argv: list[str]) -> argparse.Namespace:
    """Parse the command line; end the process with code 2 when it is wrong."""
    parser = argparse.ArgumentParser(prog="python -m autonomy", description="Loads one log, or executes a mission.")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument(
        "--controller", type=local_address_argument, required=True, help="HOST:PORT that accepts setpoints"
    )
    parser.add_argument("--report-port", type=int, required=True, help="local UDP port for state reports")
    parser.add_argument("--scene", type=address_argument, required=True, help="HOST:PORT of the log detector")
    parser.add_argument("--log", type=int, help="number of the log to pick (default: the best one)")
    parser.add_argument("--mission", type=Path, help="mission file to execute, in any format of `timberhand plan`")
    parser.add_argument("--missions", type=Path, metavar="DIR", help="wait for a mission of this folder to be uploaded")
    parser.add_argument("--progress", type=Path, help="checkpoint file of the mission, from which it is resumed")
    parser.add_argument("--manager", choices=TABLES, default="ours", help="transition table of the activity manager")
    parser.add_argument("--planner", default=SEARCH, help=f"grasp planner: {', '.join(NAMES)}, or of another package")
    parser.add_argument(
        "--virtual-cameras",
        type=int,
        default=1,
        metavar="N",
        help="places of the virtual camera over which a network's predictions are averaged",
    )
    parser.add_argument(
        "--plan-pictures", default="", metavar="DIR", help="with a network: a picture of every plan into this folder"
    )
    parser.add_argument(
        "--memory",
        action="store_true",
        help="the detector's camera looks ahead of the driving machine, and the crane works from memory",
    )
    parser.add_argument(
        "--tell",
        type=local_address_argument,
        action="append",
        default=[],
        help="HOST:PORT that receives mission reports",
    )
    parser.add_argument("--order-port", type=int, help="local UDP port for operator commands to the mission")
    parser.add_argument("--lease-ms", type=int, default=200, help="validity of a setpoint")
    parser.add_argument("--key-file", type=Path, help="file with the key that authenticates datagrams")
    options = parser.parse_args(argv)
    try:
        options.planner = PlannerChoice(options.planner, options.virtual_cameras, options.plan_pictures).check()
    except InputRefused as error:
        parser.error(str(error))
    if options.progress is not None and (options.mission is None or options.order_port is None):
        parser.error("--progress needs --mission and --order-port: a resumed mission waits for the command Auto")
    if options.missions is not None and (options.mission is not None or options.order_port is None):
        parser.error("--missions needs --order-port and no --mission: it waits for an upload")
    if options.memory and ((options.mission or options.missions) is None or options.progress is not None):
        parser.error("--memory needs --mission, and cannot resume one: what lies in the bunk is only remembered")
    return options


# -- Exit codes of the planning process.

FINE: Final = 0
"""The log lies in the bunk, or the mission is finished."""
CONFIGURATION: Final = 3
"""Profile, mission, checkpoint or key cannot be used."""
BUSY: Final = 4
"""A port is in use."""
SAFETY: Final = 5
"""Interrupted while the controller was in STOP or FAULT."""
FAILED: Final = 6
"""The job failed."""
INTERRUPTED: Final = 130


# -- Events of the planning process: JSON lines on stdout.


def emit(event: str, **fields: object) -> None:
    """Write one event with the time and its fields; fields that are None are left out."""
    line = {"event": event, "t_s": round(time.monotonic(), 3), **{k: v for k, v in fields.items() if v is not None}}
    sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
    sys.stdout.flush()
