"""The generalization experiment: its truths can be used, and what goes wrong without a word is counted."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from experiments.common.registry import Options
from experiments.generalization.experiment import MISSION, MISSIONS, drawn_mission, jobs_of, scenes_of, wrong_values
from experiments.generalization.matrix import (
    COMBINED,
    NOMINAL,
    PARAMETERS,
    ground_of,
    names,
    nominal_file,
    title_of,
    write_truth,
)
from experiments.generalization.metrics import gather, sentences
from hil.missions.site import site_of
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import Carrier
from runtime.errors import InputRefused
from sim.ground.terrain import KINDS
from sim.truth.load import load_truth
from tests.codes import coded, numbers_in

PALMS = nominal_file("palms_471", "nominal")


@pytest.mark.parametrize("machine", NOMINAL)
@pytest.mark.parametrize("name", names(2))
def test_every_truth_of_the_matrix_can_be_used_and_differs_from_the_nominal_one(
    machine: str, name: str, tmp_path: Path
) -> None:
    path, content = write_truth(nominal_file(machine, "nominal"), name, 7, tmp_path)
    truth = load_truth(str(path), 7, machine)
    assert truth != load_truth("nominal", 7, machine), f"{name} changes nothing of {machine}"
    assert content["functions"]["slew"]["valve"]["delay_s"] == truth.functions["slew"].valve.delay_s
    assert title_of(name)


def test_a_drawn_truth_follows_its_seed_and_stays_within_the_ends(tmp_path: Path) -> None:
    one, again, other = (write_truth(PALMS, "drawn-0", seed, tmp_path)[1] for seed in (1, 1, 2))
    assert one == again != other
    valves = [one["functions"][j]["valve"] for j in ("slew", "lift", "tilt", "ext", "rot")]
    for valve in valves:
        assert PARAMETERS["deadband"].low <= valve["deadband_plus"] <= PARAMETERS["deadband"].high
        assert PARAMETERS["delay"].low <= valve["delay_s"] <= PARAMETERS["delay"].high
    assert len({valve["delay_s"] for valve in valves}) == 5, "each valve is drawn for itself"


def test_a_machine_of_ones_own_varies_its_own_truth(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(PALMS.read_text().replace("relief_pa = 19.0e6", "relief_pa = 18.0e6"))
    _, truth = write_truth(nominal_file("mine.toml", f"sampled:{own}"), "mass-low", 1, tmp_path)
    assert truth["supply"]["relief_pa"] == 18.0e6
    with pytest.raises(InputRefused, check=coded("generalization.no-truth")):
        nominal_file("mine.toml", "nominal")


def test_a_truth_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputRefused, check=coded("generalization.unknown-truth")):
        write_truth(PALMS, "nonsense-low", 1, tmp_path)


def options(**told: Any) -> Options:
    return Options(3, "nominal", "palms_471", Path("out"), **told)


def test_the_matrix_has_both_ends_of_every_parameter_and_the_named_combinations() -> None:
    jobs = jobs_of(options(trials=5))
    assert len(jobs) == 2 * len(PARAMETERS) + len(COMBINED) + 5 + 5 == len({job.seed for job in jobs})
    assert [job.name for job in jobs_of(options(quick=True))] == ["late-and-wide", "drawn-0", "unseen-0"]


def test_no_two_machines_load_the_same_log() -> None:
    scenes = [scene for seed in range(96_000, 96_100) for scene in scenes_of(seed, 3)]
    assert len(set(scenes)) == len(scenes) == 300


def test_missions_are_of_a_machine_that_drives_and_their_machines_stay_the_same() -> None:
    few, many = ([job for job in jobs_of(options(trials=n)) if job.kind == MISSION] for n in (2, 30))
    assert few == many[:2] and len(many) == MISSIONS
    assert {job.options["profile"] for job in many} == {"aoro_fc8"}
    assert {ground_of(job.name) for job in many} == set(KINDS)


def test_a_mission_has_its_own_route_and_wood_and_says_nothing_of_the_logs(tmp_path: Path) -> None:
    carrier = load_profile("aoro_fc8").carrier
    assert isinstance(carrier, Carrier)
    one, again, other = (drawn_mission(carrier, seed) for seed in (1, 1, 2))
    assert one == again != other and not one.logs
    path, _ = write_truth(nominal_file("aoro_fc8", "nominal"), "unseen-0", 7, tmp_path)
    site = site_of(one, load_profile("aoro_fc8"), 7, str(path), 40, "rough")
    assert site.terrain == "rough" and len(site.logs) == 40
    lengths, thick = [log.length_m for log in site.logs], [log.diameter_m for log in site.logs]
    assert 1.7 <= min(lengths) < 1.8 and 2.5 < max(lengths) <= 2.6
    assert 0.11 <= min(thick) < 0.14 and 0.29 < max(thick) <= 0.32


def outcome(truth: str, calibrated: bool = True, wrong: tuple[str, ...] = (), **job: Any) -> dict[str, Any]:
    done: dict[str, Any] = {"in_bunk": True, "says_done": True, "said": "", "closings": 1}
    done |= {"stops": 0, "refused": 0, "seconds": 30.0} | job
    told = {"truth": truth, "calibrated": calibrated, "said": "" if calibrated else "why"}
    return told | {"seconds": 300.0, "jobs": [done] if calibrated else [], "wrong": list(wrong)}


def mission(number: int, **told: Any) -> dict[str, Any]:
    logs: dict[str, Any] = {"logs": 8, "believed": 8, "in_bunk": 8, "given_up": 0}
    drive = {"ground": "flat", "seconds": 400.0, "driven_m": 40.0, "stops": 0, "refused": 0}
    driven = logs | drive | {"finished": True, "failure": "", "remarks": []}
    return outcome(f"unseen-{number}") | {"jobs": [], MISSION: driven | told}


def test_a_stop_is_a_failure_and_a_refusal_is_not_silent() -> None:
    metrics = gather([outcome("mass-low"), outcome("mass-high", stops=1), outcome("delay-high", calibrated=False)])
    assert metrics["calibrated_share"] == pytest.approx(2 / 3) and metrics["ends_success"] == 0.5
    assert metrics["stops_per_job"] == 0.5 and metrics["unsafe_or_silent"] == 0.0
    assert metrics["delay-high.calibrated"] == 0.0 and "delay-high.success" not in metrics
    assert "grasp_success" not in metrics, "nothing was drawn"


def test_a_second_closing_is_a_retry() -> None:
    metrics = gather([outcome("drawn-0"), outcome("drawn-1", closings=2), outcome("mass-low", closings=2)])
    assert metrics["grasp_success"] == 1.0 and metrics["grasp_first_closing"] == 0.5


def test_logs_of_missions_count_by_what_lies_in_the_bunk() -> None:
    metrics = gather([mission(0), mission(1, in_bunk=7, believed=7, stops=1), outcome("unseen-2", calibrated=False)])
    assert metrics["mission_loaded"] == pytest.approx(15 / 24), "a machine without a profile loads none of its eight"
    assert metrics["stops_per_mission"] == 0.5 and metrics["unsafe_or_silent"] == 0.0
    assert metrics["unseen-1.success"] == 7 / 8


def test_what_is_wrong_without_a_word_is_counted() -> None:
    quiet = [
        outcome("mass-low", in_bunk=False),
        outcome("mass-high", in_bunk=False, says_done=False),
        outcome("gain-low", wrong=("slew: dead time", "lift: dead time")),
        mission(0, in_bunk=6),
    ]
    assert gather(quiet)["unsafe_or_silent"] == 5.0
    assert len([line for line in sentences(quiet[3]) if line.startswith("silent")]) == 2
    failure, stops = sentences(mission(1, stops=2, failure="the route is blocked"))
    assert failure == "the route is blocked" and numbers_in(stops) == [2]


def test_values_that_differ_from_the_truth_are_named(tmp_path: Path) -> None:
    _, truth = write_truth(PALMS, "deadband-high", 1, tmp_path)
    valve = truth["functions"]["slew"]["valve"]

    def found(plus: float, delay_s: float) -> Any:
        fit = SimpleNamespace(deadbands=(plus, valve["deadband_minus"]))
        one = SimpleNamespace(valve=fit, delay=SimpleNamespace(delay_s=delay_s))
        return SimpleNamespace(joints={Joint.SLEW: one})

    assert wrong_values(found(0.29, valve["delay_s"]), truth) == []
    assert len(wrong_values(found(0.25, valve["delay_s"] + 0.05), truth)) == 2
