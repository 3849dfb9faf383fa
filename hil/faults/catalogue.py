"""The fault catalogue as a table: the 45 entries of docs/reference/safety.md section 5, each with what is injected.

One row is one entry: number, name, the work during which it happens, how a random injection is drawn, and what is
promised (reaction, bound, blind spot).  Detection is observed from outside: the mode and reason that the recorded ticks
replay to, the frames on the buses, and the counters of the reports.  The draws are in `hil.faults.draws`; entries that
need a start-up, a file or a socket instead of a running machine name the check that does it (`Where`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from random import Random
from typing import Final

from hil.faults import draws
from hil.faults.draws import Injection, Scene


class Where(StrEnum):
    """How an entry is exercised."""

    RUN = "run"
    """In a running machine, in lockstep."""
    START = "start"
    """In the start of a machine, in lockstep."""
    FILES = "files"
    """On real files, clocks or sockets."""


class Work(StrEnum):
    """What the machine does when the fault comes."""

    CRANE = "crane"
    HOLD = "hold"
    """The crane has moved, and holds its pose."""
    CARRY = "carry"
    """Carrying a log to the bunk."""
    DRIVE = "drive"
    PLC = "plc"
    """Crane work through a PLC."""


@dataclass(frozen=True, slots=True)
class Case:
    """One entry.  ``promise``: a needed input is lost, so every function must be neutral within 100 ms.

    ``physics``: the fault acts on oil or steel, so the plant with physics runs; otherwise the kinematic machine does.
    ``blind``: what is not seen, and why, in a sentence for the evidence page.  ``blind_in``: the works in which a miss
    is that named blind spot, ``blind_as``: the verdicts that are it in every work (`experiments.faults.trial`),
    ``blind_most_m``: the greatest harm that it explains [m]; any other miss is unexplained.
    """

    number: int
    name: str
    title: str
    reaction: str
    bound: str
    works: tuple[Work, ...]
    draw: Callable[[Random, Scene], Injection] | None
    where: Where = Where.RUN
    physics: bool = False
    promise: bool = False
    blind: str = ""
    blind_in: tuple[Work, ...] = ()
    blind_as: tuple[str, ...] = ()
    blind_most_m: float = math.inf

    @property
    def label(self) -> str:
        """Number and name, as its evidence page is called."""
        return f"{self.number:02d}-{self.name}"


_C, _D, _P = Work.CRANE, Work.DRIVE, Work.PLC
_CRANE, _DRIVE, _BOTH, _ALL, _PATHS = (_C,), (_D,), (_C, _D), (_C, _D, _P), (_C, _P)
_FILES, _START = Where.FILES, Where.START

CASES: Final[tuple[Case, ...]] = (
    Case(
        1,
        "encoder-frozen",
        "Encoder frozen while commanded",
        "H",
        "300 ms moving",
        _PATHS,
        draws.encoder_frozen,
        physics=True,
        blind="At rest a frozen encoder looks like a joint that stands still, and one that freezes as "
        "the joint slows down to turn is told at the next motion. Behind a PLC no spool is measured, and the valve's "
        "dead time can make it late by 0.1 s.",
        blind_in=(_P,),
        blind_as=("late", "undetected"),
        blind_most_m=0.25,
    ),
    Case(
        2,
        "encoder-jump",
        "Encoder jumps",
        "one refused; three: R1",
        "10 ms (2 T), third sample",
        _CRANE,
        draws.encoder_jump,
    ),
    Case(
        3,
        "encoder-drift",
        "Encoder drifts by 0.5 deg/s",
        "H, at the next hold",
        "6000 ms of holding",
        (_C, Work.HOLD),
        draws.encoder_drift,
        physics=True,
        blind_in=(_C,),
        blind_most_m=0.25,
        blind="In motion: 0.5 deg/s is 2 to 6 % of a joint's speed, and the flow through a valve "
        "is known no better. It is seen once the crane holds its pose and nothing else has moved for a second; until "
        "then the tip strays with the encoder.",
    ),
    Case(4, "encoder-noise", "Encoder noise times ten", "D", "500 ms", _CRANE, draws.encoder_noise),
    Case(
        5,
        "encoder-scale",
        "Encoder sign or scale swapped",
        "R1",
        "200 ms, tip travel < 0.15 m",
        _CRANE,
        draws.encoder_scale,
        physics=True,
        blind_as=("undetected", "late", "far"),
        blind_most_m=0.25,
        blind="A joint that slows down to turn shows little of its scale: it is told at its next motion. The way of "
        "the tip holds that of an ordinary stop from the same speed, which alone can be 15 cm.",
    ),
    Case(
        6,
        "message-off",
        "A sensor's frames stop",
        "R1, brake",
        "20 ms; on mach0 time-out + T",
        _ALL,
        draws.message_off,
        promise=True,
    ),
    Case(
        7,
        "message-delayed",
        "A sensor's frames come late",
        "below 3 P none; beyond: R1",
        "20 ms",
        _BOTH,
        draws.message_delayed,
        promise=True,
    ),
    Case(
        8, "message-repeated", "A sensor repeats its frame", "R1", "20 ms", _BOTH, draws.message_repeated, promise=True
    ),
    Case(
        9,
        "crc-failure",
        "Checksum wrong: one frame, or a burst",
        "one dropped; burst: R1",
        "30 ms",
        _BOTH,
        draws.crc_failure,
        promise=True,
    ),
    Case(
        10,
        "counter-skip",
        "Frames are lost",
        "one counted; more than two: R1",
        "10 ms beyond the time-out",
        _BOTH,
        draws.counter_skip,
        promise=True,
    ),
    Case(11, "masquerade", "Right checksum, wrong Data ID", "R1", "10 ms", _BOTH, draws.masquerade, promise=True),
    Case(
        12,
        "babbling-node",
        "A node fills the bus",
        "R1, nodes stop by time-out",
        "50 ms",
        _BOTH,
        draws.babble,
        promise=True,
    ),
    Case(
        13,
        "bus-off",
        "Our CAN controller goes bus-off",
        "R0 by the node's time-out",
        "20 ms self, node 50 ms",
        _BOTH,
        draws.bus_off,
        promise=True,
    ),
    Case(14, "error-passive", "Error-passive", "D", "100 ms", _CRANE, draws.error_passive),
    Case(
        15,
        "cable-cut",
        "Cable cut",
        "R0 by the node's time-out; we latch (R1)",
        "30 ms",
        _ALL,
        draws.cable_cut,
        promise=True,
    ),
    Case(
        16,
        "valve-stuck-closed",
        "Valve stuck closed",
        "H",
        "400 ms",
        _PATHS,
        draws.valve_closed,
        physics=True,
        blind_in=(_P,),
        blind_most_m=0.25,
        blind="Behind a PLC no spool is measured; the joint is compared with the PLC's output, from a "
        "tenth of its speed limit on.",
    ),
    Case(
        17,
        "valve-stuck-open",
        "Valve stuck open, spool drifts",
        "R0",
        "150 ms, tip travel < 0.20 m",
        _PATHS,
        draws.valve_open,
        physics=True,
        blind_in=(_P,),
        blind_as=("late", "far"),
        blind_most_m=1.2,
        blind="Behind a PLC no spool is measured: the joint's own motion tells, 0.2 to 0.4 s after the fault. Where "
        "it is measured, a joint at more than half of its speed goes further than 20 cm until its valve is shut, and "
        "a spool that sticks within a sixth of its command is told when the command has left it.",
    ),
    Case(18, "valve-gain", "Valve gain changed by half", "D", "2000 ms", _CRANE, draws.valve_gain, physics=True),
    Case(
        19,
        "node-reset",
        "The valve node resets",
        "neutral until a person arms (R1)",
        "100 ms",
        _CRANE,
        draws.node_reset,
        promise=True,
    ),
    Case(20, "hose-burst", "Hose burst", "R0", "100 ms", _CRANE, draws.hose_burst, physics=True),
    Case(
        21,
        "overload",
        "Overload, tip-over moment",
        "outward and lift blocked (D or harder)",
        "50 ms after the machine carries too much",
        _CRANE,
        draws.overload,
        physics=True,
    ),
    Case(
        22, "planner-killed", "Planner killed", "H at the end of its lease", "lease + 10 ms", _ALL, draws.planner_killed
    ),
    Case(
        23,
        "planner-hung",
        "Planner hangs, then goes on",
        "H at the end of its lease",
        "lease + 10 ms",
        _BOTH,
        draws.planner_hung,
    ),
    Case(24, "planner-nan", "Setpoint with NaN or Inf", "refused; three: H", "10 ms", _BOTH, draws.planner_nan),
    Case(
        25,
        "planner-range",
        "Goal out of reach",
        "refused, the present motion goes on",
        "10 ms",
        _BOTH,
        draws.planner_range,
        blind="Goals in a zone are the envelope's affair; here goals out of range are sent.",
    ),
    Case(26, "planner-jump", "Step in the setpoint", "refused; three: H", "10 ms", _CRANE, draws.planner_jump),
    Case(
        27,
        "planner-replay",
        "Setpoint replayed, late or from the future",
        "refused",
        "10 ms",
        _BOTH,
        draws.planner_replay,
    ),
    Case(28, "planner-corrupt", "Setpoint datagram damaged", "refused", "10 ms", _BOTH, draws.planner_corrupt),
    Case(29, "gnss-lost", "GNSS lost", "stop (H)", "stop <= 2300 ms", _DRIVE, draws.gnss_lost),
    Case(
        30,
        "gnss-jump",
        "GNSS jumps, or falls to a single fix",
        "stop (H)",
        "200 ms after its frame; fix 1200 ms",
        _DRIVE,
        draws.gnss_jump,
    ),
    Case(31, "heading-wrong", "Heading flips or freezes", "stop (H)", "500 ms moving", _DRIVE, draws.heading_wrong),
    Case(
        32,
        "emergency-stop",
        "Emergency stop pressed, or its wire broken",
        "R0",
        "20 ms",
        _ALL,
        draws.estop,
        promise=True,
    ),
    Case(33, "supervisor-link", "The supervisor's link is lost", "H", "1000 ms", _ALL, draws.supervisor_link),
    Case(
        34,
        "control-overrun",
        "Control loop late",
        "D; beyond 3 T: H; beyond 50 ms: the valve node",
        "5/15/200 ms",
        _BOTH,
        draws.overrun,
    ),
    Case(35, "wall-clock", "Wall clock stepped", "none: the same commands", "0", _CRANE, None, _FILES),
    Case(
        36,
        "disk-full",
        "Disk full while recording",
        "recorder stops with a warning, control untouched",
        "1000 ms",
        _CRANE,
        None,
        _FILES,
    ),
    Case(
        37,
        "power-cut",
        "Power cut at any byte of a log or profile",
        "at most 250 ms lost",
        "2 s at start",
        _CRANE,
        None,
        _FILES,
    ),
    Case(
        38, "wrong-node", "A node is not the one of the profile", "X", "2 s at start", _CRANE, draws.wrong_node, _START
    ),
    Case(39, "two-controllers", "Another controller on the bus", "R0", "20 ms", _BOTH, draws.foreign, promise=True),
    Case(40, "malformed-mission", "Malformed mission file", "refused at load", "1 s", _CRANE, None, _FILES),
    Case(
        41,
        "person-in-zone",
        "Person in the zone",
        "H",
        "300 ms",
        _BOTH,
        draws.person,
        blind="Only the safety module's input is watched. No camera looks for persons; a blind one goes unseen.",
    ),
    Case(
        42,
        "log-slips",
        "Grapple opens under load",
        "slew over the cabin stops",
        "300 ms",
        (Work.CARRY,),
        draws.log_slips,
        physics=True,
        blind="An opening grapple is seen only by the planner, at the next verification of its grasp.",
    ),
    Case(
        43,
        "ground-tilts",
        "Machine tilts",
        "H while driving",
        "200 ms",
        _DRIVE,
        draws.tilt,
        blind="Roll and pitch are not watched while the crane works.",
    ),
    Case(
        44,
        "joystick",
        "Hand lever moved during automatic work",
        "H, neutral at once: the person wins",
        "20 ms",
        _BOTH,
        draws.lever,
        blind="A machine that does not tell when a lever is out of neutral: see docs/safety.md.",
    ),
    Case(45, "forged-command", "Forged or replayed operator command", "refused", "at once", _BOTH, draws.forged),
)
BY_NAME: Final = {case.name: case for case in CASES}
