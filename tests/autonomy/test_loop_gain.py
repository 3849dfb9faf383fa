"""Loop gains that a measured dead time bears: kept where they may stay, lowered by their margins where they may not."""

from __future__ import annotations

from types import SimpleNamespace

import msgspec
import pytest

from autonomy.calibration.loop_gain import GAIN_MARGIN_DB, PHASE_MARGIN_DEG, borne_gain_1_s, margins
from machine.loading.checks import MAX_GAIN_DELAY
from machine.loading.profile_file import load_profile

PROFILES = {name: load_profile(name) for name in ("palms_471", "aoro_fc8")}


def measured(delay_s: float, lag_s: float = 0.04, oil_s: float = 0.04):
    """A joint's result as far as a gain depends on it."""
    return SimpleNamespace(
        delay=SimpleNamespace(delay_s=delay_s, lag_s=lag_s), valve=SimpleNamespace(lags_s=(oil_s, oil_s))
    )


def test_margins_of_a_pure_delay_are_the_closed_forms() -> None:
    phase_deg, gain_db = margins(2.0, 0.2, 1e-4, 0.0)
    assert phase_deg == pytest.approx(90.0 - 2.0 * 0.2 * 57.3, abs=0.6)
    assert gain_db == pytest.approx(11.9, abs=0.2)  # 20 log10(pi / 2 / 0.4)


@pytest.mark.parametrize("name", PROFILES)
def test_the_shipped_gains_stay_at_the_shipped_dead_times(name: str) -> None:
    for spec in PROFILES[name].joints.values():
        assert borne_gain_1_s(spec, measured(spec.valve.delay_s)) == spec.law.kp_1_s


@pytest.mark.parametrize("delay_s", [0.149, 0.2, 0.25])
@pytest.mark.parametrize("name", PROFILES)
def test_a_lowered_gain_has_its_margins_and_is_no_lower_than_it_must_be(name: str, delay_s: float) -> None:
    lowered = 0
    for spec in PROFILES[name].joints.values():
        kp = borne_gain_1_s(spec, measured(delay_s))
        assert kp * delay_s <= MAX_GAIN_DELAY and kp <= spec.law.kp_1_s
        phase_deg, gain_db = margins(kp, delay_s, 0.04, 0.04)
        assert phase_deg >= PHASE_MARGIN_DEG and gain_db >= GAIN_MARGIN_DB
        if kp < spec.law.kp_1_s:
            lowered += 1
            more = margins(1.15 * kp, delay_s, 0.04, 0.04)
            assert more[0] < PHASE_MARGIN_DEG or more[1] < GAIN_MARGIN_DB or 1.15 * kp * delay_s > 0.9 * MAX_GAIN_DELAY
    assert lowered >= 1 or delay_s < 0.2


def test_without_a_measured_dead_time_a_gain_stays() -> None:
    spec = PROFILES["palms_471"].joints["ext"]
    assert borne_gain_1_s(msgspec.structs.replace(spec), SimpleNamespace(delay=None)) == spec.law.kp_1_s
