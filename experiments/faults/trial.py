"""One injection: forked from a running machine, watched until it stands, and judged.

A child process continues the machine of its parent, so all injections of a scene share its start-up; the parent stays
at the moment of the fork.  The same scene, case and seed give the same outcome, in a child as in a fresh process.
"""

from __future__ import annotations

import gc
import json
import math
import os
import signal
import traceback
from collections.abc import Callable, Mapping
from random import Random
from typing import Any, Final

from autonomy.crane_job.phases import Phase
from experiments.common.pool import Job
from experiments.faults.running import Running, build, warm
from hil.faults.catalogue import CASES, Where
from hil.faults.draws import Injection
from hil.faults.table import Order
from hil.harness.lockstep import SLICE_NS, START_NS
from machine.joints import JOINTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused

# -- Whether an injection was answered as the catalogue promises.  Pure: an outcome in, a verdict out.


SEVERITY: Final = {"D": 1, "H": 2, "R1": 3, "R0": 4}
STOPS: Final = ("H", "R1", "R0")
T_MS: Final = 5.0
NODE_MS: Final = 200.0
"""Bound of a dead controller: the valve node's own time-out makes the valves neutral."""


def judge(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``detect_ms`` (None: never), ``verdict`` and ``missed`` of an outcome.

    Verdicts: ok; late (after the bound); undetected; weak (a milder reaction than promised); tripped (a stop where
    nothing may stop); far (more tip travel than promised).  All but ok count as missed.
    """
    expected, reached = outcome["expected"], outcome["reached"]
    due_ms = outcome.get("due_ms", 0.0)
    # A fault between two ticks is met by the next; where the bound does not begin, any reaction is in time.
    bound_ms = outcome["bound_ms"] + outcome["seen_ms"] + T_MS + (math.inf if due_ms is None else due_ms)
    stops = [reached[r] for r in STOPS if r in reached]
    match expected:
        case "NONE":
            return _answer(min(stops) if stops else None, "tripped" if stops else "ok")
        case "REFUSED":
            refused = outcome["refused_ms"]
            if stops:
                return _answer(refused, "tripped")
            return _answer(refused, _timed(refused, bound_ms))
        case "X":
            return _answer(reached.get("X"), _timed(reached.get("X"), bound_ms))
        case "NODE":
            return _answer(outcome["valves_ms"], _timed(outcome["valves_ms"], bound_ms))
    enough = [ms for r, ms in reached.items() if SEVERITY.get(r, 0) >= SEVERITY[expected]]
    if not enough:
        return _answer(min(reached.values(), default=None), "weak" if reached else "undetected")
    detect_ms = min(enough)
    verdict = _timed(detect_ms, bound_ms)
    limit_m = outcome["tip_limit_m"]
    if verdict == "ok" and limit_m is not None and outcome["astray_m"] > limit_m:
        verdict = "far"
    return _answer(detect_ms, verdict)


def _timed(found_ms: float | None, bound_ms: float) -> str:
    if found_ms is None:
        return "undetected"
    return "ok" if found_ms <= bound_ms else "late"


def _answer(detect_ms: float | None, verdict: str) -> dict[str, Any]:
    return {"detect_ms": detect_ms, "verdict": verdict, "missed": verdict != "ok"}


# -- One injection


EARLIEST_S, LATEST_S = 0.0, 2.0
"""When the injection comes after the fork."""
MOVING_SHARE: Final = 0.2
"""A joint moves if it is faster than this share of its limit (the motion monitor's own, docs/reference/safety.md 1)."""
WAIT_FOR_MOTION_S: Final = 6.0
REST_S: Final = 0.5
MAX_REST_S: Final = 2.5
STILL_M: Final = 0.002
"""The tip stands when it moves less than this in a tenth of a second."""
CHILD_LIMIT_S: Final = 120


def perform(job: Job) -> dict[str, Any]:
    """Make all injections of one case in one scene; options: case, scene, count."""
    case = CASES[job.options["case"] - 1]
    scene, count = job.options["scene"], job.options["count"]
    outcomes = []
    if case.where is Where.RUN:
        machine = warm(scene)
        gc.collect()
        gc.freeze()
        for i in range(count):
            seed = f"{case.name} {scene} {job.seed} {i}"
            outcomes.append(in_child(lambda seed=seed: inject(machine, job.options["case"], seed)))  # type: ignore[misc]
    else:
        for i in range(count):
            seed = f"{case.name} {scene} {job.seed} {i}"
            outcomes.append(in_child(lambda seed=seed: start(scene, job.options["case"], seed)))  # type: ignore[misc]
    return {"case": case.number, "scene": scene, "outcomes": outcomes}


def inject(machine: Running, number: int, seed: str) -> dict[str, Any]:
    """Inject a drawn fault into the running machine and follow it; ``machine`` is used up."""
    case, random = CASES[number - 1], Random(seed)
    assert case.draw is not None
    drawn = case.draw(random, machine.scene)
    _wait(machine, random, drawn)
    system, evidence = machine.system, machine.evidence
    at_ns = system.next_tick_ns if drawn.aligned else system.now_ns + random.randrange(SLICE_NS)
    for order in drawn.orders:
        machine.injector.order(order, at_ns + round(order.at_s * 1e9))
    evidence.begin(at_ns, machine.scene.drives)
    before_ms = (at_ns - START_NS) * 1e-6
    travel_m, astray_m, valves_ms, standing, due_ms = _follow(machine, drawn, at_ns)
    outcome = {
        "seed": seed,
        "at_ms": round(before_ms, 3),
        "orders": [_words(o) for o in drawn.orders],
        "expected": drawn.expected,
        "bound_ms": drawn.bound_ms,
        "seen_ms": drawn.seen_ms,
        "due_ms": due_ms,
        "tip_limit_m": drawn.tip_limit_m,
        "reached": evidence.reached,
        "reason": evidence.reason,
        "refused_ms": evidence.refused_ms,
        "neutral_ms": evidence.neutral_ms if evidence.frames else None,
        "valves_ms": valves_ms,
        "travel_m": round(travel_m, 4),
        "astray_m": round(astray_m, 4),
        "standing": standing,
        "timeline": evidence.timeline[:16],
    }
    return outcome | judge(outcome)


def start(scene: str, number: int, seed: str) -> dict[str, Any]:
    """Inject a fault before the machine's first boot and see whether it can be armed."""
    case, random = CASES[number - 1], Random(seed)
    machine = build(scene)
    assert case.draw is not None
    drawn = case.draw(random, machine.scene)
    for order in drawn.orders:
        machine.injector.order(order, START_NS)
    machine.evidence.begin(START_NS, machine.scene.drives)
    system, refused_ms, armed, reason = machine.system, None, False, 0
    while system.now_ns < START_NS + round(2.0 * drawn.bound_ms * 1e6):
        machine.advance()
        if system.report is not None:
            armed = armed or system.report.mode in (Mode.ARMED, Mode.ACTIVE)
            named = Reason(system.report.reason & 0xFF) in (Reason.NODE_IDENTITY, Reason.NODE_CONFIGURATION)
            if named and refused_ms is None:
                refused_ms, reason = round((system.now_ns - START_NS) * 1e-6, 3), system.report.reason & 0xFF
    reached = {} if refused_ms is None or armed else {"X": refused_ms}
    outcome = {
        "seed": seed,
        "at_ms": 0.0,
        "orders": [_words(o) for o in drawn.orders],
        "expected": drawn.expected,
        "bound_ms": drawn.bound_ms,
        "seen_ms": 0.0,
        "tip_limit_m": None,
        "reached": reached,
        "reason": Reason(reason).name if reason else "",
        "refused_ms": refused_ms,
        "neutral_ms": 0.0,
        "valves_ms": 0.0,
        "travel_m": 0.0,
        "astray_m": 0.0,
        "standing": not armed,
        "timeline": machine.evidence.timeline[:16],
    }
    return outcome | judge(outcome)


def _words(order: Order) -> str:
    """Write the order as a person writes it, without its moment."""
    order_text = order.fault if not order.part else f"{order.fault}/{order.part}"
    order_text += f"+{1e3 * order.length_s:.4g}ms" if math.isfinite(order.length_s) else ""
    return order_text + (f"={order.sized():.4g}" if math.isfinite(order.sized()) and order.sized() else "")


def _wait(machine: Running, random: Random, drawn: Injection) -> None:
    """Run to the moment of the injection: a random one, at which the joint moves that has to."""
    system = machine.system
    until_ns = system.now_ns + round(random.uniform(EARLIEST_S, LATEST_S) * 1e9)
    while system.now_ns < until_ns:
        machine.advance()
    if not drawn.moves:
        return
    j = next(int(j) for j in JOINTS if j.name.lower() == drawn.moves)
    needed = MOVING_SHARE * machine.scene.profile.joints[drawn.moves].speed_limit
    limit_ns = system.now_ns + round(WAIT_FOR_MOTION_S * 1e9)
    while system.now_ns < limit_ns and not (system.report and abs(system.report.velocity[j]) > needed):
        machine.advance()


def _follow(machine: Running, drawn: Injection, at_ns: int) -> tuple[float, float, float | None, bool, float | None]:
    """Watch until everything stands, or the window is over.

    Way of the tip [m]; how far it went astray [m]: its greatest distance from its reference while the machine is
    active, less that at the beginning, and its way after that; time at which the valve node's outputs became
    neutral for good [ms]; whether it stands; from when the bound counts [ms], None where that moment did not come.
    """
    system, evidence = machine.system, machine.evidence
    window_ns = at_ns + round((drawn.window_s or drawn.bound_ms * 1e-3 + 0.5) * 1e9)
    last_position, usual_m = machine.place(), machine.astray_m()
    travel_m = astray_m = overrun_m = 0.0
    mark, mark_ns, valves_ms, standing = last_position, system.now_ns, None, False
    stop_ns = 0
    due_ms = None if drawn.after_overload else 0.0
    while True:
        machine.advance()
        if due_ms is None and machine.overloaded():
            due_ms = round((system.now_ns - at_ns) * 1e-6, 3)
        now_ns, position = system.now_ns, machine.place()
        step_m = math.dist(position, last_position)
        travel_m += step_m
        last_position = position
        if system.report is not None and system.report.mode == Mode.ACTIVE:
            astray_m = max(astray_m, machine.astray_m() - usual_m)
        else:
            overrun_m += step_m
        if not machine.valves_neutral():
            valves_ms = None
        elif valves_ms is None:
            valves_ms = round((now_ns - at_ns) * 1e-6, 3)
        if now_ns - mark_ns >= 100_000_000:
            standing = math.dist(position, mark) < STILL_M
            mark, mark_ns = position, now_ns
        if machine.phase() not in (None, Phase.CARRY, Phase.LOWER):  # the planner gives the carry up
            evidence.reached.setdefault("H", round((now_ns - at_ns) * 1e-6, 3))
        neutral = evidence.neutral_ms is not None and not machine.holds  # a crane that holds is neutral anyway
        stopped = any(r in evidence.reached for r in ("H", "R1", "R0")) or neutral
        stop_ns = stop_ns or (now_ns if stopped else 0)
        over = now_ns >= window_ns
        if stopped and drawn.expected not in ("NONE", "REFUSED"):
            over = (standing and now_ns >= stop_ns + round(REST_S * 1e9)) or now_ns >= stop_ns + round(MAX_REST_S * 1e9)
        if over:
            return travel_m, astray_m + overrun_m, valves_ms, standing, due_ms


def in_child(function: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of a function that runs in a forked child, which leaves this process as it is.

    Raises:
        InputRefused: the child failed; its traceback is in the sentence.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.alarm(CHILD_LIMIT_S)
        try:
            answer_text = json.dumps(function())
        except BaseException:  # noqa: BLE001  the parent must hear of everything, and the child must not go on
            answer_text = json.dumps({"failed": traceback.format_exc()})
        try:
            with os.fdopen(writing, "w") as pipe:
                pipe.write(answer_text)
        finally:
            os._exit(0)  # whatever happens, the child must not go on as its parent
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    _, status = os.waitpid(child, 0)
    answer: dict[str, Any] = json.loads(text) if text else {"failed": f"the child ended with status {status}"}
    if "failed" in answer:
        raise InputRefused("experiment.injection-failed", f"an injection failed: {answer['failed']}")
    return answer
