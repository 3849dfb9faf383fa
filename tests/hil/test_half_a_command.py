"""One of the two valve commands is lost while the crane moves: every spool's command is neutral within 100 ms."""

from __future__ import annotations

import pytest

from can_dbc.dbc.codec import load
from hil.harness.lockstep import SLICE_NS
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from tests.hil.sweep import Sweep, watched

CRANE = load("crane")


@pytest.mark.long
@pytest.mark.parametrize("lost", ["ValveCmdA", "ValveCmdB"])
def test_neutral_within_100_ms_of_losing_half_a_command(lost: str) -> None:
    run = watched("palms_471", Sweep(load_profile("palms_471"), Joint.SLEW), truth="nominal")
    key, gone = CRANE.message(lost).key, []
    try:
        assert run.run(8.0, lambda: abs(run.plant.valve.outputs_pct[0]) > 30.0)
        run.system._observer.on_outputs.append(
            lambda outputs, now_ns: outputs.frames.__setitem__(
                slice(None), [frame for frame in outputs.frames if frame[0] != key]
            )
        )
        lost_ns = run.system.now_ns
        for _ in range(200_000_000 // SLICE_NS):
            run.system.advance()
            gone.append(any(run.plant.valve.outputs_pct))
        neutral_ms = (gone.index(False) + 1) * SLICE_NS / 1e6
        assert not any(gone[gone.index(False) :]) and run.system.now_ns > lost_ns
        assert neutral_ms < 100.0
    finally:
        run.plant.close()
