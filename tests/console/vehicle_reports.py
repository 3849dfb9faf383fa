"""A vehicle report for tests of the console."""

from __future__ import annotations

import math

from can_dbc.messages.vehicle import Driving, VehicleReport
from machine.loading.profile_file import load_profile, profile_hash
from tests.can_dbc.example_mission_report import HERE

PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)
VEHICLE = VehicleReport(
    1,
    HASH,
    10**9,
    3,
    Driving.DRIVING,
    0,
    0,
    10**9,
    *HERE,
    102.0,
    4,
    18,
    0.014,
    10**9,
    math.pi / 2,
    0.0,
    10**9,
    0.64,
    0.2,
    0.02,
    -0.03,
    (0.35, 0.34, 0.33, 0.32),
    0,
)
