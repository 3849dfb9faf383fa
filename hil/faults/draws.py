"""How an injection of each catalogue entry is drawn at random: orders, expected reaction, and bound.

Bounds are fault detection times (docs/reference/safety.md section 4), from the moment of the fault to the tick that
reacts.  A report shows a refusal up to one report period later, which `Injection.seen_ms` allows for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from random import Random
from typing import Final

from controller.crane.inputs import sample_timeout_ns
from hil.faults.table import Order
from machine.joints import JOINTS
from machine.profile import Profile
from sim.plant_faults import ENCODER_MESSAGES, message

REPORT_MS: Final = 20.0
T_MS: Final = 5.0
LEASE_MS: Final = 200.0
"""Lease of the setpoints in the campaign: the planner's own (`autonomy`)."""
SETPOINT_MS: Final = 50.0
"""Period of the setpoints in the campaign, crane's and carrier's (`autonomy.motion.setpoint_stream`)."""
REFUSED_LIMIT: Final = 3
"""So many refused setpoints within a second hold the machine (docs/reference/safety.md cases 24 to 28)."""
REFUSED_MS: Final = REFUSED_LIMIT * SETPOINT_MS + 10.0
"""The third bad setpoint comes at most so many periods after the fault, and is met within the 10 ms of the catalogue.
The lease of the last good one ends 150 to 200 ms after the fault, so a stop by it is later and must not pass here."""
_DEG: Final = math.pi / 180.0
_NEEDED_CRANE: Final = ("EstopStat", "ValveFbA", "ValveFbB")
_NEEDED_DRIVE: Final = ("VehStat", "ArmHeightA", "ArmHeightB")


@dataclass(frozen=True, slots=True)
class Scene:
    """Where an injection happens: the machine, and whether it drives."""

    profile: Profile
    drives: bool = False
    plc: bool = False


@dataclass(frozen=True, slots=True)
class Injection:
    """One drawn injection; times of ``orders`` count from its moment.

    ``expected`` is the least reaction: NONE (nothing may stop), REFUSED (counted, nothing stops), D, H, R1, R0, X.
    ``moves``: the moment must be one at which this joint moves.  ``tip_limit_m``: largest tip travel that is promised.
    """

    orders: tuple[Order, ...]
    expected: str
    bound_ms: float
    seen_ms: float = 0.0
    moves: str = ""
    tip_limit_m: float | None = None
    window_s: float = 0.0
    """How long to watch; 0 means the bound and half a second."""
    after_overload: bool = False
    """The bound counts from the moment at which the machine carries more than it bears, by the ground truth."""
    aligned: bool = False
    """The moment must be the beginning of a tick, when the controller sends."""


def _joint(random: Random, scene: Scene) -> str:
    return random.choice([j.name.lower() for j in JOINTS if scene.profile.joints[j.name.lower()].encoder is not None])


def _arm_joint(random: Random) -> str:
    return random.choice(("slew", "lift", "tilt", "ext"))


def _one(
    random: Random,
    fault: str,
    expected: str,
    bound_ms: float,
    part: str = "",
    size: float = math.nan,
    length_s: float = math.inf,
    moves: str = "",
    seen_ms: float = 0.0,
    tip_limit_m: float | None = None,
    window_s: float = 0.0,
) -> Injection:
    order = Order(fault, part, 0.0, length_s, size, random.getrandbits(32))
    return Injection((order,), expected, bound_ms, seen_ms, moves, tip_limit_m, window_s)


def encoder_frozen(random: Random, scene: Scene) -> Injection:
    joint = _joint(random, scene)
    return _one(random, "encoder-stuck", "H", 300.0, joint, moves=joint)


def encoder_jump(random: Random, scene: Scene) -> Injection:
    joint, size = _joint(random, scene), random.choice((-1.0, 1.0)) * random.uniform(0.1, 0.3)
    if random.random() < 0.5:
        return _one(random, "encoder-jump", "NONE", 10.0, joint, size, length_s=0.004)
    return _one(random, "encoder-jump", "R1", 10.0 + 2 * T_MS, joint, size, length_s=0.05)


def encoder_drift(random: Random, scene: Scene) -> Injection:
    """Draw a drift, bounded by the drift monitor for a crane that holds its pose (docs/reference/safety.md case 3)."""
    joint = random.choice(("slew", "lift", "tilt", "ext"))
    rate = random.choice((-1.0, 1.0)) * (0.5 * _DEG if joint != "ext" else 0.01)
    return _one(random, "encoder-drift", "D", 6000.0, joint, rate)


def encoder_noise(random: Random, scene: Scene) -> Injection:
    return _one(random, "encoder-noise", "D", 500.0, _joint(random, scene), 10.0)


def encoder_scale(random: Random, scene: Scene) -> Injection:
    joint, scale = _arm_joint(random), random.choice((-1.0, 0.5, 2.0))
    return _one(random, "encoder-scale", "R1", 200.0, joint, scale, moves=joint, tip_limit_m=0.15)


def _needed(random: Random, scene: Scene) -> str:
    """Draw a message that the present work needs."""
    if scene.drives:
        return random.choice((*_NEEDED_CRANE, *_NEEDED_DRIVE))
    encoders = [ENCODER_MESSAGES[n] for n, s in scene.profile.joints.items() if s.encoder is not None]
    names: tuple[str, ...] = (*_NEEDED_CRANE, *encoders)
    return random.choice(names)


def _protected(random: Random, scene: Scene) -> str:
    names: tuple[str, ...] = _NEEDED_CRANE + _NEEDED_DRIVE if scene.drives else _NEEDED_CRANE
    return random.choice(names)


def _lost_ms(scene: Scene, name: str) -> float:
    """Return the bound for a message's loss: its time-out and one tick.  A PLC measures joints in its own period."""
    timeout_ns = message(scene.profile, name)[1].timeout_ns
    if scene.plc and name in ENCODER_MESSAGES.values():
        timeout_ns = sample_timeout_ns(scene.profile)
    return max(20.0, timeout_ns * 1e-6 + T_MS)


def message_off(random: Random, scene: Scene) -> Injection:
    name = _needed(random, scene)
    return _one(random, "message-off", "R1", _lost_ms(scene, name), name)


def message_delayed(random: Random, scene: Scene) -> Injection:
    name = _needed(random, scene)
    codec = message(scene.profile, name)[1]
    period_ms = max(T_MS, codec.cycle_time_ns * 1e-6)
    timeout_periods = codec.timeout_ns * 1e-6 / period_ms
    if random.random() < 0.5:
        size = random.uniform(0.5, 0.6 * timeout_periods) * period_ms
        return _one(random, "message-delayed", "NONE", 0.0, name, size, window_s=0.6)
    size = random.uniform(1.3, 2.0) * timeout_periods * period_ms
    return _one(random, "message-delayed", "R1", _lost_ms(scene, name), name, size)


def message_repeated(random: Random, scene: Scene) -> Injection:
    name = _protected(random, scene)
    return _one(random, "message-stuck", "R1", _lost_ms(scene, name) + T_MS, name)


def crc_failure(random: Random, scene: Scene) -> Injection:
    name = _protected(random, scene)
    codec = message(scene.profile, name)[1]
    period_s = max(0.005, codec.cycle_time_ns * 1e-9)
    if random.random() < 0.5:
        return _one(random, "bus-corrupt", "NONE", 0.0, name, length_s=0.9 * period_s, window_s=0.6)
    return _one(random, "bus-corrupt", "R1", max(30.0, 3e3 * period_s), name, length_s=max(0.03, 4 * period_s))


def counter_skip(random: Random, scene: Scene) -> Injection:
    name = _protected(random, scene)
    codec = message(scene.profile, name)[1]
    period_s = max(0.005, codec.cycle_time_ns * 1e-9)
    if random.random() < 0.5:
        return _one(random, "bus-drop", "NONE", 0.0, name, 1.0, length_s=0.9 * period_s, window_s=0.6)
    lost_s = random.uniform(1.3, 3.0) * codec.timeout_ns * 1e-9
    return _one(random, "bus-drop", "R1", _lost_ms(scene, name) + T_MS, name, 1.0, length_s=lost_s)


def masquerade(random: Random, scene: Scene) -> Injection:
    name = _protected(random, scene)
    period_ms = message(scene.profile, name)[1].cycle_time_ns * 1e-6
    return _one(random, "message-masquerade", "R1", 2.0 * max(T_MS, period_ms) + T_MS, name)


def _bus(random: Random, scene: Scene) -> str:
    crane, machine = scene.profile.crane_bus, scene.profile.machine_bus
    return random.choice((crane, machine)) if scene.drives and machine else crane


def babble(random: Random, scene: Scene) -> Injection:
    bus = _bus(random, scene)
    return _one(random, "bus-babble", "R1", 50.0 if bus == scene.profile.crane_bus else 100.0 + T_MS, bus)


def bus_off(random: Random, scene: Scene) -> Injection:
    """Draw bus-off.  It takes 32 errors: 5 ms on crane0, 20 ms on mach0, where the next frame may be 20 ms away too."""
    bus = _bus(random, scene)
    return _one(random, "bus-errors", "R0", 20.0 + (10.0 if bus == scene.profile.crane_bus else 40.0), bus, 1.0)


def error_passive(random: Random, scene: Scene) -> Injection:
    """Draw seventeen errors in a row, which make a node error-passive; thirty-two would switch it off."""
    return replace(_one(random, "bus-errors", "D", 100.0, scene.profile.crane_bus, 1.0, length_s=0.0027), aligned=True)


def cable_cut(random: Random, scene: Scene) -> Injection:
    """Draw a cut cable.  A PLC has another one, whose loss shows after an exchange of 10 ms and its status time-out."""
    if scene.plc and random.random() < 0.5:
        return _one(random, "plc-off", "R1", 100.0 + 10.0)
    bus = _bus(random, scene)
    bound = 30.0 if bus == scene.profile.crane_bus else 100.0 + T_MS
    return _one(random, random.choice(("bus-cut", "bus-stub")), "R1", bound, bus)


def valve_closed(random: Random, scene: Scene) -> Injection:
    joint = _joint(random, scene)
    return _one(random, "valve-stuck", "H", 400.0, joint, 0.0, moves=joint)


def valve_open(random: Random, scene: Scene) -> Injection:
    joint, size = _arm_joint(random), random.choice((-1.0, 1.0)) * random.uniform(0.45, 0.9)
    return _one(random, "valve-stuck", "R0", 150.0, joint, size, tip_limit_m=0.20)


def valve_gain(random: Random, scene: Scene) -> Injection:
    joint = _arm_joint(random)
    return _one(random, "valve-gain", "D", 2000.0, joint, random.choice((0.5, 1.5)), moves=joint)


def node_reset(random: Random, scene: Scene) -> Injection:
    return _one(random, "node-reset", "R1", 100.0, "valves")


def hose_burst(random: Random, scene: Scene) -> Injection:
    return _one(random, "hose-burst", "R0", 100.0, random.choice(("lift", "tilt")))


def overload(random: Random, scene: Scene) -> Injection:
    """Draw a mass on the rotator.  The bound counts from the moment at which the machine carries more than it bears.

    A mass that appears falls with the crane: nothing holds it, and nothing presses on the machine, until it has
    compressed the lift's oil.  The moment about the tipping line exceeds its limit 220 to 240 ms after the mass
    appears.  50 ms after it there is nothing to judge: 3000 kg have raised the lift's pressure by 7 bar, 200 kg, which
    the machine bears, by 3.4 bar, and it rises no faster than in ordinary work (40 kNm/s).  A machine that stops before
    it carries too much is in time: near the crane the larger one never tips, because its lift yields first.
    """
    drawn = _one(random, "load-overload", "D", 50.0, "", random.uniform(1500.0, 3000.0), window_s=1.5)
    return replace(drawn, after_overload=True)


def planner_killed(random: Random, scene: Scene) -> Injection:
    return _one(random, "process-off", "H", LEASE_MS + 10.0, "planner")


def planner_hung(random: Random, scene: Scene) -> Injection:
    length_s = random.uniform(0.3, 0.8)
    return _one(random, "process-stuck", "H", LEASE_MS + 10.0, "planner", length_s=length_s, window_s=1.5)


def _some_bad(random: Random, fault: str) -> Injection:
    """Draw one bad datagram, which is refused, or several: from the third in a second on the machine stops."""
    if random.random() < 0.5:
        return _one(
            random, fault, "REFUSED", SETPOINT_MS + 10.0, length_s=1e-3 * SETPOINT_MS, seen_ms=REPORT_MS, window_s=0.6
        )
    return _one(random, fault, "H", REFUSED_MS, window_s=1.0)


def planner_nan(random: Random, scene: Scene) -> Injection:
    return _some_bad(random, "planner-nan")


def planner_range(random: Random, scene: Scene) -> Injection:
    return _some_bad(random, random.choice(("planner-range", "planner-speed")))


def planner_jump(random: Random, scene: Scene) -> Injection:
    return _some_bad(random, "planner-jump")


def planner_replay(random: Random, scene: Scene) -> Injection:
    fault = random.choice(("planner-replay", "planner-future"))
    injection = _some_bad(random, fault)
    if fault == "planner-replay":  # the first datagram is the one that is repeated, and itself good
        order = injection.orders[0]
        longer = replace(order, length_s=order.length_s + 1e-3 * SETPOINT_MS)
        return replace(injection, orders=(longer,), bound_ms=injection.bound_ms + SETPOINT_MS)
    return injection


def planner_corrupt(random: Random, scene: Scene) -> Injection:
    return _some_bad(random, "planner-garbage")


def gnss_lost(random: Random, scene: Scene) -> Injection:
    return _one(random, "gnss-off", "H", 2300.0)


def gnss_jump(random: Random, scene: Scene) -> Injection:
    """Draw a jump, which is in the next position frame: 100 ms of period and 100 ms of the receiver's own delay."""
    if random.random() < 0.5:
        return _one(random, "gnss-jump", "H", 200.0 + 200.0, "", 3.0)
    return _one(random, "gnss-single", "H", 1200.0 + 200.0)


def heading_wrong(random: Random, scene: Scene) -> Injection:
    fault = random.choice(("heading-flip", "heading-stuck"))
    return _one(random, fault, "H", 500.0 + 200.0, window_s=3.0)


def estop(random: Random, scene: Scene) -> Injection:
    return _one(random, random.choice(("estop-pressed", "estop-wire")), "R0", 20.0)


def supervisor_link(random: Random, scene: Scene) -> Injection:
    return _one(random, "operator-off", "H", float(scene.profile.timeouts.operator_link_ms))


def overrun(random: Random, scene: Scene) -> Injection:
    match random.randrange(3):
        case 0:  # one tick late by more than two periods and 10 ms
            late_s = random.uniform(0.021, 0.040)
            return _one(random, "process-stuck", "D", 1e3 * late_s + T_MS, "controller", length_s=late_s)
        case 1:
            late_s = random.uniform(0.060, 0.150)
            return _one(random, "process-stuck", "H", 1e3 * late_s + T_MS, "controller", length_s=late_s)
    return _one(random, "process-off", "NODE", 200.0, "controller")


def wrong_node(random: Random, scene: Scene) -> Injection:
    return _one(random, "encoder-identity", "X", 2000.0, _joint(random, scene))


def foreign(random: Random, scene: Scene) -> Injection:
    return _one(random, "bus-foreign", "R0", 20.0, _bus(random, scene))


def person(random: Random, scene: Scene) -> Injection:
    return _one(random, "person-in-zone", "H", 300.0)


def lever(random: Random, scene: Scene) -> Injection:
    """Draw a lever that is held, or only touched: either ends the automatic work."""
    return _one(random, "lever-moved", "H", 20.0, length_s=random.choice((math.inf, random.uniform(0.05, 0.5))))


def log_slips(random: Random, scene: Scene) -> Injection:
    return _one(random, "valve-stuck", "H", 300.0, "grapple", random.uniform(0.3, 1.0))


def tilt(random: Random, scene: Scene) -> Injection:
    return _one(random, "ground-tilt", "H", 200.0, "", random.choice((-1.0, 1.0)) * random.uniform(0.35, 0.6))


def forged(random: Random, scene: Scene) -> Injection:
    return _one(random, "planner-arms", "REFUSED", 60.0, length_s=0.05, seen_ms=REPORT_MS, window_s=0.6)
