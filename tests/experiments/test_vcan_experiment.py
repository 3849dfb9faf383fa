"""The vcan experiment: what it reads from a run, its metrics, and when the host is to blame."""

from __future__ import annotations

from typing import Any

from experiments.common.result import evaluate
from experiments.vcan.experiment import METRICS, gather, noisy, read_output, read_summary
from machine.status.explanation import describe
from machine.status.reasons import Reason

TOLD = f"""   1.6 s  controller ACTIVE
  40.6 s  STOP: {describe(Reason.LEASE_LOST)}
  41.6 s  operator presses ARM
  44.9 s  FAULT: {describe(Reason.VALVE_FEEDBACK_LOST)}
  45.0 s  STOP    st   -3.2°  bus 2260 frames/s
"""


def outcome(kind: str = "demo", seed: int = 1, clock: str = "real", **changed: Any) -> dict[str, Any]:
    return {
        "kind": kind,
        "seed": seed,
        "exit": 0,
        "wall_s": 50.0,
        "steal_ms": 10.0,
        "lost_ms": 5.0,
        "longest_ms": 2.0,
        "probe_real_time": True,
        "clock": clock,
        "clock_reason": "enough",
        "stop_reasons": [],
        "leases_lost": 0,
        "done": True,
        "stops": 0,
        "refused": 0,
        "missed_ticks": 0,
        "seconds": 40.0,
        **changed,
    }


def test_stops_ended_leases_and_the_announced_clock_are_read_from_the_output() -> None:
    found = read_output(TOLD, "vcan lab: simulated time: the host is too busy\nvcan lab: uml: no AF_CAN\n")
    assert (found["clock"], found["clock_reason"]) == ("simulated", "the host is too busy")
    assert len(found["stop_reasons"]) == 2 and found["leases_lost"] == 1
    assert read_output("", "")["clock"] == "native"


def test_both_summaries_are_read_and_a_missing_one_is_not_done() -> None:
    assert read_summary({"in_bunk": True, "refused_setpoints": 3, "stops": 2})["refused"] == 3
    mission = {"finished": True, "in_bunk": 3, "loaded": 3, "refused": 1, "stops": 0}
    assert read_summary(mission)["done"] and read_summary(mission)["refused"] == 1
    assert not read_summary(mission | {"in_bunk": 2})["done"] and not read_summary({})["done"]


def test_a_stop_on_a_quiet_host_misses_the_limit_and_simulated_time_never_counts_as_real() -> None:
    quiet = {f"demo-{i}": outcome(seed=i) for i in range(10)}
    metrics = gather(quiet)
    assert not noisy(quiet) and evaluate(METRICS, metrics, False) == ((), ())
    stopped = quiet | {"demo-3": outcome(seed=3, stops=1)}
    assert evaluate(METRICS, gather(stopped), noisy(stopped)) == (("demo_stops",), ())
    stolen = stopped | {"demo-4": outcome(seed=4, longest_ms=60.0)}
    assert evaluate(METRICS, gather(stolen), noisy(stolen)) == ((), ("demo_stops",))
    travelled = quiet | {"demo-5": outcome(seed=5, clock="simulated")}
    metrics = gather(travelled)
    assert (metrics["demo_real"], metrics["demo_simulated"]) == (9.0, 1.0)
    assert evaluate(METRICS, metrics, noisy(travelled)) == ((), ("demo_real_share",))


def test_a_run_that_is_not_done_is_missed_on_any_host() -> None:
    failed = {"demo-1": outcome(done=False, clock="simulated")}
    assert "demo_done" in evaluate(METRICS, gather(failed), noisy(failed))[0]
