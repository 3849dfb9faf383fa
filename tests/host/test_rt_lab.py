"""The labs: what a run on Debian's PREEMPT_RT kernel must have shown, and the moving states of the service lab."""

from __future__ import annotations

from typing import Any

import pytest

from host.rt_lab import guest, host
from host.rt_lab.host import EXPECTED, POSITIVE, evaluate
from host.service_lab.trial import MOVING
from sim.nodes.valve import ValveState

GOOD: dict[str, Any] = {
    **EXPECTED,
    **dict.fromkeys(POSITIVE, 1),
    "kernel": "6.1 #1 SMP PREEMPT_RT Debian",
    "neutral_ms": 77.0,
}


def test_a_good_result_has_no_fault() -> None:
    assert evaluate(GOOD) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kernel", "6.1 #1 SMP PREEMPT_DYNAMIC Debian"),
        ("realtime", None),
        ("controller_policy", "other 0"),
        ("refused", ["mlockall: Cannot allocate memory"]),
        ("controller_locked_kb", 0),
        ("ticks", 0),
        ("neutral_ms", 101.0),
        ("neutral_ms", None),
        ("opening_pct", 0.0),
        ("error", "OSError: no vcan"),
    ],
)
def test_each_check_can_fail(name: str, value: object) -> None:
    faults = evaluate(GOOD | {name: value})
    assert len(faults) == 1 and str(value) in faults[0]


def test_guest_and_host_name_the_same_modules() -> None:
    assert guest.MODULES == host.MODULES


def test_the_moving_states_of_the_service_lab_are_those_of_the_valve_node() -> None:
    assert set(MOVING) == {ValveState.ACTIVE, ValveState.RAMP}
