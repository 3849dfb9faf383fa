"""A planner that waits for a mission, with a controller's reports played by us."""

from __future__ import annotations

import socket
import time
from dataclasses import replace
from math import nan

from autonomy.process.command_line import arguments
from autonomy.process.job_setup import make_job, uploaded_missions
from autonomy.process.planner_process import PlannerProcess
from can_dbc.messages.crane import ModeSwitch, StateReport
from can_dbc.messages.datagrams import encode
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from tests.console.vehicle_reports import VEHICLE

PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)


def planner_process(tell: int, key: bytes | None, *more: str) -> PlannerProcess:
    """The process's shell and job, reporting to a port."""
    there = "127.0.0.1:9"
    options = arguments(
        [
            "--profile",
            "aoro_fc8",
            "--controller",
            there,
            "--scene",
            there,
            "--report-port",
            "0",
            "--order-port",
            "0",
            "--tell",
            f"127.0.0.1:{tell}",
            *more,
        ]
    )
    uploads = uploaded_missions(options, PROFILE, 10**8, key)
    return PlannerProcess(make_job(options, PROFILE, 10**8, key), HASH, options, key, uploads)


def report_machine(
    to: tuple[str, int],
    key: bytes | None,
    mode: Mode = Mode.STANDBY,
    speed_m_s: float = 0.0,
    switch: ModeSwitch = ModeSwitch.NOT_FITTED,
) -> None:
    """Send a state and a vehicle report."""
    q, now = (0.0,) * 5, time.monotonic_ns()
    state = StateReport(1, HASH, now, mode, 0, 0, 1, 0, 0, 0, q, q, q, nan, nan, nan, 0, 0, 0, 0, mode_switch=switch)
    vehicle = replace(VEHICLE, profile_hash=HASH, stamp_ns=now, speed_m_s=speed_m_s)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for message in (state, vehicle):
            out.sendto(encode(message, key), to)
