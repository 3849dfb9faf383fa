"""The services under a real systemd in user-mode Linux."""

from __future__ import annotations

from host.service_lab.trial import MOVING


def test_the_moving_states_are_those_of_the_valve_node() -> None:
    from sim.nodes.valve import ValveState

    assert set(MOVING) == {ValveState.ACTIVE, ValveState.RAMP}
