"""The page's state of controller and crane, from the newest reports.

Pure: datagrams and integer times in, JSON-ready dictionaries out.  An unknown number (NaN) becomes None.  Peaks (tick
time, delay) are maxima of the last second, because the page is updated less often than the controller reports.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import cos, sin
from typing import Any, Final

from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import LinkWatch, StateReport
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import ChosenGrasp, MissionReport, decode_grasp
from can_dbc.messages.vehicle import VehicleReport
from can_dbc.timing.durations import BINS, edge_ns
from can_dbc.timing.page import Timing
from console.fault_watch import FaultWatch
from console.mission_state import MissionState, describe_carrier
from console.timeline import Timeline
from machine.geometry import grapple, kinematics
from machine.geometry.map_projection import MapProjection
from machine.joints import JOINTS, Joint
from machine.profile import Profile, joint
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.stale_inputs import STALE_INPUT_NAMES

# -- The numbers of a shift: logs, volume, stops, metres driven and working time, from the reports as they arrive.
# Pure.
#
# A shift begins with the console's first report of the controller or when a person begins a new one, and counts
# whether a page is open or not.  Of a mission that had begun before, only what follows is counted.


MIN_RATE_NS: Final = 300_000_000_000
"""Volume per hour is told from this time on: before, a single log decides it."""
MAX_GAP_NS: Final = 1_000_000_000
"""Between reports that are farther apart it is unknown whether the machine worked."""


@dataclass(slots=True)
class _Counts:
    """What a shift has counted."""

    logs: int = 0
    volume_m3: float = 0.0
    driven_m: float = 0.0
    lifts: int = 0
    stops: int = 0
    working_ns: int = 0


class Shift:
    """Takes reports in their order."""

    def __init__(self) -> None:
        self._begun_ns: int | None = None
        self._counts = _Counts()
        self._mission: MissionReport | None = None
        self._report_ns = 0
        self._events_known = (0, 0)

    def begin(self, now_ns: int) -> None:
        """Begin a new shift now; the present mission is counted from here."""
        self._begun_ns, self._counts = now_ns, _Counts()

    def on_report(self, report: StateReport, now_ns: int, stops: int, lifts: int) -> None:
        """Take a state report; ``stops`` and ``lifts`` are those of the timeline since the console began."""
        if self._begun_ns is None:
            self.begin(now_ns)
        counts, (stops_known, lifts_known) = self._counts, self._events_known
        counts.stops += stops - stops_known
        counts.lifts += lifts - lifts_known
        self._events_known = (stops, lifts)
        if report.mode == Mode.ACTIVE and 0 < now_ns - self._report_ns < MAX_GAP_NS:
            counts.working_ns += now_ns - self._report_ns
        self._report_ns = now_ns

    def on_mission(self, report: MissionReport) -> None:
        """Take a mission report."""
        last, self._mission = self._mission, report
        if last is None or last.name != report.name or report.loaded < last.loaded:
            return
        counts = self._counts
        counts.logs += report.loaded - last.loaded
        counts.driven_m += max(0.0, report.driven_m - last.driven_m)
        gained_m3 = report.on_board_m3 - last.on_board_m3
        if report.loaded > last.loaded and math.isfinite(gained_m3):
            counts.volume_m3 += max(0.0, gained_m3)

    def numbers(self, now_ns: int) -> dict[str, Any] | None:
        """Return the numbers for the page; None before the first report."""
        if self._begun_ns is None:
            return None
        c, long_ns = self._counts, now_ns - self._begun_ns
        return {
            "seconds": round(long_ns * 1e-9),
            "working_s": round(c.working_ns * 1e-9),
            "logs": c.logs,
            "lifts": c.lifts,
            "stops": c.stops,
            "driven_m": round(c.driven_m, 1),
            "m3": round(c.volume_m3, 3),
            "m3_h": round(c.volume_m3 * 3.6e12 / long_ns, 2) if long_ns >= MIN_RATE_NS else None,
        }


# -- The histograms of the timing page, coarse enough for a plot: counts between 1, 2 and 5 of each decade.  Pure.


EDGES_US: Final = tuple(step * 10**power for power in range(6) for step in (1, 2, 5))[:16]
"""Upper edges 1 us to 100 ms; what is longer is in one more bar."""
SHOWN: Final = {
    "wake": "wake-up latency",
    "tick": "tick, by the clock",
    "cpu": "tick, processor time",
    "sample_to_command": "sample to command",
}


def _bar_of(i: int) -> int:
    edge_us = edge_ns(i) / 1e3
    return next((bar for bar, edge in enumerate(EDGES_US) if edge_us <= edge), len(EDGES_US))


_BARS: Final = tuple(_bar_of(i) if i < BINS - 1 else len(EDGES_US) for i in range(BINS))


def histograms(timing: Timing) -> dict[str, Any]:
    """Return edges [us] and for each measured time its counts, median, 99.9 % and longest [us]."""
    time_histograms = []
    for name, caption in SHOWN.items():
        durations = timing.durations[name]
        counts = [0] * (len(EDGES_US) + 1)
        for i, n in enumerate(durations.bins):
            if n:
                counts[_BARS[i]] += n
        summary = durations.summary()
        time_histograms.append({"name": name, "words": caption, "counts": counts, **summary})
    return {"edges_us": list(EDGES_US), "period_us": timing.facts.period_ns / 1e3, "of": time_histograms}


# -- The chosen grasp for the page, in the crane's base frame; pure, like `console.state`.


TIMEOUT_NS: Final = 1_500_000_000
"""A grasp that has not been repeated for this long is over; the planner repeats it twice a second."""


class GraspState:
    """Accepts the planner's grasps; those of another machine are refused."""

    def __init__(self, profile: Profile, profile_hash: int, key: bytes | None) -> None:
        self._hash, self._key = profile_hash, key
        jaws = profile.grapple.jaws
        self._half_gap_m, self._below_m = grapple.half_gap_m(jaws, 0.0), grapple.tip_below_pin_m(jaws, 0.0)
        self._grasp: ChosenGrasp | None = None
        self._received_ns = 0

    def on_grasp(self, datagram: bytes, now_ns: int) -> bool:
        """Accept a datagram; False when it is no grasp of this machine."""
        try:
            profile_hash, _, grasp = decode_grasp(datagram, self._key)
        except DatagramRefused:
            return False
        if self._hash and profile_hash != self._hash:
            return False
        self._grasp, self._received_ns = grasp, now_ns
        return True

    def shown(self, now_ns: int) -> dict[str, Any] | None:
        """Return hanger pin and both tips of the open jaws [m], logs and reason; None when no grasp is chosen."""
        g = self._grasp
        if g is None or now_ns - self._received_ns > TIMEOUT_NS:
            return None
        x, y, z = g.pin_m
        across = (self._half_gap_m * cos(g.yaw_rad), self._half_gap_m * sin(g.yaw_rad))
        return {
            "pin": list(g.pin_m),
            "tips": [
                [round(x + s * across[0], 4), round(y + s * across[1], 4), round(z - self._below_m, 4)]
                for s in (-1.0, 1.0)
            ],
            "logs": list(g.logs),
            "reason": g.reason,
        }


# -- The page's state of controller and crane, from the newest reports


REPORT_TIMEOUT_NS: Final = 300_000_000
"""Without a report for this long the controller is shown as disconnected."""
WINDOW_NS: Final = 1_000_000_000
TIMING_TIMEOUT_NS: Final = 3_000_000_000
"""The controller writes its timing once a second."""

LINK_WORDS: Final[dict[int, str]] = {LinkWatch.OFF: "not watched", LinkWatch.WATCHED: "watched", LinkWatch.LOST: "lost"}
PARTS: Final = ("column", "boom", "stick", "telescope", "grapple")
_NAMES: Final = tuple((j.name.lower(), PARTS[j]) for j in JOINTS)


def describe_machine(profile: Profile) -> dict[str, Any]:
    """Return the machine's constant data: names, limits, geometry of bunk and surroundings."""
    bunk, workspace = profile.bunk, profile.workspace
    return {
        "name": profile.name,
        "title": profile.title,
        "joints": [
            {"name": name, "part": part, "kind": spec.kind, "lower": spec.lower, "upper": spec.upper}
            for (name, part), spec in zip(_NAMES, (joint(profile, j) for j in JOINTS), strict=True)
        ],
        "hold_pressure_bar": profile.grapple.hold_pressure_bar,
        "bunk": {name: getattr(bunk, name) for name in bunk.__struct_fields__},
        "ground_z_m": workspace.ground_z_m,
        "pick_center_m": workspace.pick_center_m,
        "pick_half_size_m": workspace.pick_half_size_m,
        "reach_m": round(kinematics.max_reach_m(profile), 2),
        "carrier": describe_carrier(profile),
    }


class CraneState:
    """Accepts reports and log lists and returns the page's state; ``mission_state`` is that of vehicle and mission,
    ``grasp_state`` the chosen grasp."""

    def __init__(
        self, profile: Profile, key: bytes | None = None, profile_hash: int = 0, ground: MapProjection | None = None
    ) -> None:
        self.logs: tuple[LogObservation, ...] = ()
        self.mission_state = MissionState(profile, profile_hash, key, ground)
        self.timeline = Timeline()
        self.shift = Shift()
        self.fault_watch = FaultWatch(profile)
        self.grasp_state = GraspState(profile, profile_hash, key)
        self.listener: Callable[[StateReport | VehicleReport], None] | None = None
        """Called with every report of the controller that is accepted."""
        self.mission_listener: Callable[[MissionReport, int], None] | None = None
        """Called with every mission report that is accepted, and when the planner made it [ns]."""
        self._profile = profile
        self._key = key
        self._report: StateReport | None = None
        self._received_ns = 0
        self._recent: deque[tuple[int, StateReport]] = deque()
        self._timing: dict[str, Any] | None = None
        self._timing_ns = 0
        self._newest_timing: Timing | None = None

    def on_report(self, datagram: bytes, now_ns: int) -> bool:
        """Accept a datagram; False when it is not a report that is shown."""
        try:
            report = decode(datagram, self._key)
        except DatagramRefused:
            if self.grasp_state.on_grasp(datagram, now_ns):
                return True
            if not self.mission_state.on_mission(datagram, now_ns):
                return False
            self.timeline.on_mission(self.mission_state.report, now_ns)
            self.shift.on_mission(self.mission_state.report)
            if self.mission_listener is not None:
                self.mission_listener(self.mission_state.report, self.mission_state.stamp_ns)
            return True
        return isinstance(report, StateReport | VehicleReport) and self.accept(report, now_ns)

    def accept(self, report: StateReport | VehicleReport, now_ns: int) -> bool:
        """Accept a report of the controller."""
        if self.listener is not None:
            self.listener(report)
        if isinstance(report, VehicleReport):
            self.mission_state.on_vehicle(report, now_ns)
            return True
        self.timeline.on_report(report)
        self.shift.on_report(report, now_ns, self.timeline.stops, self.timeline.lifts)
        self.fault_watch.on_report(report)
        self._report, self._received_ns = report, now_ns
        self._recent.append((now_ns, report))
        self._forget(now_ns)
        return True

    def on_timing(self, timing: Timing) -> None:
        """Accept a state of the controller's timing page."""
        self._timing, self._timing_ns = timing_facts(timing.named()), timing.facts.written_ns
        self._newest_timing = timing

    @property
    def report(self) -> StateReport | None:
        """The controller's newest report."""
        return self._report

    def histograms(self) -> dict[str, Any] | None:
        """Return the histograms of the newest timing page; None before the first."""
        return None if self._newest_timing is None else histograms(self._newest_timing)

    def alive(self, now_ns: int) -> bool:
        """Tell whether the controller is connected."""
        return self._report is not None and now_ns - self._received_ns < REPORT_TIMEOUT_NS

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return the state for the page; without crane data before the controller's first report."""
        r = self._report
        base = {"alive": self.alive(now_ns), "logs": [asdict(log) for log in self.logs], "timing": None}
        base["entries"] = self.timeline.count
        base["shift"] = self.shift.numbers(now_ns)
        base["grasp"] = self.grasp_state.shown(now_ns)
        base |= self.mission_state.state(now_ns)
        if self._timing and now_ns - self._timing_ns < TIMING_TIMEOUT_NS:
            base["timing"] = self._timing
        if r is None:
            return base
        self._forget(now_ns)
        window = [report for _, report in self._recent] or [r]
        return base | {
            "time_s": r.stamp_ns / 1e9,
            "silent_s": round((now_ns - self._received_ns) / 1e9, 2),
            "mode": Mode(r.mode).name if r.mode in set(Mode) else f"MODE {r.mode}",
            "reason": _sentence(r.reason, r.numbers),
            "position": _numbers(r.position),
            "reference": _numbers(r.reference),
            "opening_pct": _number(r.opening_pct),
            "clamp_bar": _number(r.clamp_bar),
            "load_kg": _number(r.load_kg),
            "tick_ms": max(w.tick_ns for w in window) / 1e6,
            "late_ms": max(w.late_ns for w in window) / 1e6,
            "missed_ticks": r.missed_ticks,
            "frames_per_s": _rate(window),
            "refused": r.refused,
            "refusal": _sentence(r.refusal) if r.refusal else "",
            "operator_link": LINK_WORDS.get(r.operator_link, ""),
            "stale": [STALE_INPUT_NAMES.get(b, f"bit {b}") for b in range(16) if r.stale_mask >> b & 1],
            **self._drawing(r),
        }

    def _forget(self, now_ns: int) -> None:
        while self._recent and self._recent[0][0] < now_ns - WINDOW_NS:
            self._recent.popleft()

    def _drawing(self, r: StateReport) -> dict[str, Any]:
        kin, jaws = self._profile.kinematics, self._profile.grapple.jaws
        q = r.position
        if joint(self._profile, Joint.ROT).encoder is None:  # drawn at its reference
            reference = r.reference[Joint.ROT]
            q = (*q[: Joint.ROT], reference if math.isfinite(reference) else 0.0)
        if not all(map(math.isfinite, q)):
            return {"points": None, "reference_points": None}
        opening = r.opening_pct if math.isfinite(r.opening_pct) else 100.0
        angle = grapple.jaw_angle_from_opening_pct(jaws, opening)
        ghost = all(map(math.isfinite, r.reference))
        return {
            "points": _points(kinematics.chain_points(kin, q)),
            "reference_points": _points(kinematics.chain_points(kin, r.reference)) if ghost else None,
            "jaws": {
                "yaw_rad": round(grapple.grapple_yaw(self._profile, q), 4),
                "half_gap_m": round(grapple.half_gap_m(jaws, angle), 4),
                "tip_below_m": round(grapple.tip_below_pin_m(jaws, angle), 4),
            },
        }


def timing_facts(page: dict[str, Any]) -> dict[str, Any]:
    """Summarize the controller's timing since its start: durations at the 99th percentile, oldest input used.

    ``page``: the timing page as a recording has it (`Timing.named`).
    """
    durations = page["durations"]
    used = {name: age["longest_ns"] for name, age in page["inputs"].items() if age["count"]}
    oldest = max(used, key=used.__getitem__, default="")
    return {
        "ticks": page["ticks"],
        "missed": page["missed"],
        "wake_us": durations["wake"]["p99_us"],
        "cpu_us": durations["cpu"]["p99_us"],
        "sample_to_command_ms": durations["sample_to_command"]["p99_us"] / 1e3,
        "oldest_input": oldest,
        "oldest_input_ms": used[oldest] / 1e6 if oldest else None,
    }


def _points(points: kinematics.ChainPoints) -> list[list[float]]:
    return [[round(v, 4) for v in point] for point in points]


def _number(value: float) -> float | None:
    return round(value, 5) if math.isfinite(value) else None


def _numbers(values: Sequence[float]) -> list[float | None]:
    return [_number(v) for v in values]


def _rate(window: list[StateReport]) -> float | None:
    first, last = window[0], window[-1]
    elapsed_ns = last.stamp_ns - first.stamp_ns
    return (last.frames_received - first.frames_received) * 1e9 / elapsed_ns if elapsed_ns > 0 else None


def _sentence(reason: int, numbers: Sequence[float] = ()) -> str:
    try:
        return describe(reason, numbers=numbers)
    except ValueError:
        return f"The controller reports the unknown reason {reason & 0xFF}; run controller and console of one release."
