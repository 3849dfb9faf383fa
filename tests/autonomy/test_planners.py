"""Grasp planners by name, on the command line of the planning process."""

from types import SimpleNamespace

import pytest

from autonomy.grasp import planners
from autonomy.grasp.cnn_planner import CnnPlanner
from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.process.command_line import arguments
from runtime.errors import InputRefused
from tests.codes import coded

WORDS = ["--controller", "127.0.0.1:1", "--report-port", "2", "--scene", "127.0.0.1:3"]


@pytest.mark.parametrize(
    ("choice", "kind"),
    [
        (OUR_PLANNER, SamplingPlanner),
        (PlannerChoice("cnn"), CnnPlanner),
        (PlannerChoice("cnn-physical", 4), CnnPlanner),
        (PlannerChoice("cnn", 1, "."), CnnPlanner),
    ],
)
def test_a_name_makes_its_planner_and_reaches_the_planning_process(choice, kind):
    assert isinstance(choice.make(), kind)
    assert arguments([*WORDS, *choice.arguments()]).planner == choice


@pytest.mark.parametrize(
    ("choice", "code"),
    [
        (PlannerChoice("nobody"), "planner.unknown"),
        (PlannerChoice("search", 2), "planner.no-virtual-camera"),
        (PlannerChoice("search", 1, "."), "planner.no-pictures"),
        (PlannerChoice("cnn", 1, "no/such/folder"), "planner.no-folder"),
        (PlannerChoice("cnn", 0), "planner.virtual-cameras"),
        (PlannerChoice("cnn", planners.MAX_VIRTUAL_CAMERAS + 1), "planner.virtual-cameras"),
    ],
)
def test_what_no_planner_can_do_is_refused_before_anything_is_loaded(choice, code, capsys):
    with pytest.raises(InputRefused, check=coded(code)):
        choice.check()
    with pytest.raises(InputRefused, check=coded(code)):
        choice.make()
    words = ("--virtual-cameras", str(choice.virtual_cameras), "--plan-pictures", choice.pictures)
    with pytest.raises(SystemExit, match="2"):
        arguments([*WORDS, "--planner", choice.name, *words])


def test_a_planner_of_another_package_is_found_by_its_entry_point(monkeypatch):
    def entry_points(group, name=""):
        assert group == "timberhand.grasp_planners"
        return [SimpleNamespace(name="pca", load=lambda: SamplingPlanner)] if name in ("", "pca") else []

    monkeypatch.setattr("autonomy.grasp.planners.entry_points", entry_points)
    monkeypatch.setattr("runtime.plugins.entry_points", entry_points)
    assert isinstance(PlannerChoice("pca").make(), SamplingPlanner)
    with pytest.raises(InputRefused, check=coded("planner.no-virtual-camera")):
        PlannerChoice("pca", 2).check()
