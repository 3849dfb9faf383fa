"""The site of a mission: where its logs lie, as a file, and its plant."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import pytest

from machine.loading.profile_file import load_profile
from sim.__main__ import main
from sim.errors import PlantError
from sim.ground.terrain import EXTENT_M
from sim.site.log_supply import LogPlace, place_logs
from sim.site.site_file import Site, load_site
from sim.wood.log_shape import LogSpec
from tests.codes import coded

SITE = Site(63.5, 19.5, (LogSpec(8.0, 3.0, 0.3, 2.0, 0.25, 900.0), LogSpec(-35.0, 0.0, 0.0, 2.5, 0.2, 850.0)), 1, 2)


def test_logs_lie_at_their_places_and_later_ones_wait_apart() -> None:
    places = [LogPlace(4.0 * i, 3.0, 0.1 * i, 2.0, 0.25) for i in range(12)]
    scene = place_logs(load_profile("aoro_fc8"), "nominal", 1, places, rounds=2)
    assert len(scene) == 24
    for spec, place in zip(scene, places, strict=False):
        assert (spec.x_m, spec.y_m, spec.yaw_rad) == (place.x_m, place.y_m, place.yaw_rad)
        assert (spec.length_m, spec.diameter_m) == (2.0, 0.25)
    for spec in scene[12:]:
        assert max(abs(spec.x_m), abs(spec.y_m)) + spec.length_m < EXTENT_M / 2
    for a, b in combinations(scene[12:], 2):
        assert math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) > a.length_m


def test_a_saved_site_loads_equal(tmp_path: Path) -> None:
    SITE.save(tmp_path / "site.json")
    assert load_site(tmp_path / "site.json") == SITE


def test_the_plant_stands_at_the_site_among_its_logs() -> None:
    plant = SITE.plant(load_profile("aoro_fc8"), "nominal", 1)
    carrier = plant.profile.carrier
    assert (carrier.site_lat_deg, carrier.site_lon_deg) == (63.5, 19.5)
    near = [log.position_m for log in plant.logs()]
    assert [round(x) for x, *_ in near] == [8, -35]
    plant.close()


def test_a_machine_that_does_not_drive_has_no_site() -> None:
    with pytest.raises(PlantError, check=coded("site.fixed-machine")):
        SITE.plant(load_profile("palms_471"), "nominal", 1)


@pytest.mark.parametrize("content", [b"", b"[]", b'{"latitude_deg": 1}', b'{"latitude_deg": "x"}', b"\xff"])
def test_a_malformed_site_file_is_refused(content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "site.json"
    path.write_bytes(content)
    with pytest.raises(PlantError, check=coded("site.malformed")):
        load_site(path)
    message = run(path, capsys)
    assert str(path) in message and message.count("\n") == 1


def test_a_missing_site_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "none.json"
    with pytest.raises(PlantError, check=coded("site.unreadable")):
        load_site(path)
    assert str(path) in run(path, capsys)


def run(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    buses = ("--bus", "crane0=wire:crane0", "--bus", "mach0=wire:mach0")
    assert main(["--profile", "aoro_fc8", *buses, "--site", str(path)]) == 3
    return capsys.readouterr().err
