"""``timberhand survey-camera``: a camera's mount and depth scale from surveyed targets, into a new profile."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import InputRefused

if TYPE_CHECKING:
    from machine.profile import Camera


def survey_camera(
    camera: Annotated[str, typer.Argument(help="Name of the camera in the profile.")],
    targets: Annotated[Path, typer.Argument(help="CSV with u_px,v_px,x_m,y_m,z_m,depth_m, one target per line.")],
    profile: Annotated[str, typer.Option(help="Present machine profile: a shipped name or a TOML file.")],
    out: Annotated[Path, typer.Option(help="New TOML file: the profile with the surveyed camera.")] = Path(
        "surveyed.toml"
    ),
    joints: Annotated[
        str | None,
        typer.Option(help="Slew, lift, tilt in deg and telescope in m, for a camera on the crane."),
    ] = None,
    articulation_deg: Annotated[
        float, typer.Option(help="Articulation of the carrier, for a camera on its front frame.")
    ] = 0.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")] = False,
) -> None:
    """Compute a camera's mount and depth scale from surveyed targets, and write them into a new profile.

    Place six targets or more in the field of view, near and far, left and right.
    Survey each in the base frame of the crane, and record the pixel and the depth
    at which the camera sees it. The crane must not move meanwhile.

    [bold]Example[/bold]

      timberhand survey-camera stick targets.csv --profile my_crane.toml
        --joints "0 43 -92 0.3" --out surveyed.toml
    """
    import datetime

    from rich.console import Console

    from autonomy.calibration.profile_file import write_profile
    from autonomy.calibration.targets_file import load_targets
    from autonomy.perception.camera.frame import link_pose
    from autonomy.perception.camera.survey import surveyed
    from controller.guard.__main__ import profile_path
    from machine.loading.profile_file import carry_envelope, load_profile

    machine = load_profile(profile)
    observations = load_targets(targets)
    if camera not in machine.cameras:
        names = ", ".join(machine.cameras) or "none"
        raise CommandFailed(
            "survey-camera.no-camera", f"{machine.name} has no camera {camera!r}; it has: {names}", ExitCode.USAGE
        )
    before = machine.cameras[camera]
    q = _joints(joints, before)
    try:
        link = link_pose(machine, before.link, q, math.radians(articulation_deg))
        surveyed_camera = surveyed(before, link, observations.pixels_px, observations.depths_m, observations.places_m)
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.FIGURE_MISSED) from None
    remark = f"by {len(observations.places_m)} surveyed targets"
    values: dict[str, Any] = {
        "position_m": [round(v, 4) for v in surveyed_camera.position_m],
        "rpy_rad": [round(v, 5) for v in surveyed_camera.rpy_rad],
        "depth_scale": round(surveyed_camera.depth_scale, 5),
    }
    changed: list[tuple[tuple[str, ...], Any, str]] = [
        (("cameras", camera, name), value, remark) for name, value in values.items()
    ]
    source = Path(profile_path(profile))
    write_profile(source, out, changed, datetime.date.today().isoformat())
    carry_envelope(source, out.parent)
    if as_json:
        print(json.dumps({"camera": camera, "targets": len(observations.places_m), **values}, indent=2))
    moved_mm = 1000.0 * math.dist(before.position_m, surveyed_camera.position_m)
    turns = (math.remainder(b - a, math.tau) for a, b in zip(before.rpy_rad, surveyed_camera.rpy_rad, strict=True))
    turned = math.degrees(max(map(abs, turns)))
    Console(stderr=True).print(
        f"[green]✔[/green] {out} written: the mount of {camera} differs from the old profile by {moved_mm:.0f} mm and "
        f"{turned:.1f} deg, the depth scale by {100.0 * (surveyed_camera.depth_scale - 1.0):+.2f} %",
        highlight=False,
    )


def _joints(text: str | None, camera: Camera) -> list[float]:
    """Return joint positions [rad, m] in ``Joint`` order."""
    if text is None:
        if camera.link in ("boom", "stick"):
            raise CommandFailed(
                "survey-camera.joints-missing",
                f"the camera is on the {camera.link}; give the position of the crane with --joints",
                ExitCode.USAGE,
            )
        return [0.0] * 5
    try:
        slew, lift, tilt, ext = (float(word) for word in text.replace(",", " ").split())
    except ValueError:
        raise CommandFailed(
            "survey-camera.joints-malformed",
            f'--joints "{text}": expected four numbers: slew, lift, tilt in deg and telescope in m',
            ExitCode.USAGE,
        ) from None
    return [*map(math.radians, (slew, lift, tilt)), ext, 0.0]
