"""Foreign methods, found by entry point: a package that names one in its pyproject.toml is compared with ours.

Group ``timberhand.grasp_planners``: `autonomy.grasp.planners`.  Group ``timberhand.log_detectors``: a factory without
arguments that returns a `LogPictureDetector`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Protocol

from autonomy.perception.camera.frame import RgbdFrame
from runtime.errors import ConfigError, InputRefused
from runtime.plugins import load_plugin

LOG_DETECTORS: Final = "timberhand.log_detectors"


@dataclass(frozen=True, slots=True)
class SeenLog:
    """A log in the optical frame (z forward, x right, y down): middle [m], unit axis, length and diameter [m]."""

    center_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float


class LogPictureDetector(Protocol):
    """Finds the logs of one picture with depth; it has no memory."""

    def __call__(self, frame: RgbdFrame) -> Sequence[SeenLog]:
        """Detect the logs in this picture."""


def identity(group: str, name: str) -> tuple[str, ...]:
    """Tell what decides a foreign method's outcome: package, version and the module's content; nothing for none."""
    its = [point for point in entry_points(group=group) if point.name == name]
    if len(its) != 1:
        return ()
    source = find_spec(its[0].module)
    content = Path(source.origin).read_bytes() if source is not None and source.origin else b""
    package = its[0].dist.name + its[0].dist.version if its[0].dist is not None else ""
    return package, its[0].value, hashlib.sha256(content).hexdigest()


def load(group: str, name: str) -> Any:
    """Load an entry point and return what its factory makes.

    Raises:
        InputRefused: no installed package has such an entry point, several have, or it cannot be loaded.
    """
    try:
        return load_plugin(group, name)
    except ConfigError as error:
        raise InputRefused(error.code, str(error)) from error
