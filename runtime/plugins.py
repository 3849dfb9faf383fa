"""Foreign methods, found by entry point: a package names a factory in its pyproject.toml (docs/how-to/extend.md)."""

from __future__ import annotations

import re
from importlib.metadata import entry_points
from typing import Any, Final

from runtime.errors import ConfigError

NAME: Final = re.compile(r"[a-z0-9][a-z0-9_-]*")


def load_plugin(group: str, name: str, *arguments: Any) -> Any:
    """Return what the factory of an entry point makes of the arguments; most take none.

    Raises:
        ConfigError: no installed package has such an entry point, several have, or it cannot be loaded.
    """
    known = entry_points(group=group)
    points = [point for point in known if point.name == name]
    if len(points) != 1 or not NAME.fullmatch(name):
        names = ", ".join(sorted(point.name for point in known)) or "none"
        raise ConfigError(
            "plugin.unknown",
            f"{len(points)} installed packages have an entry point {name!r} in {group} (installed: {names}); exactly "
            "one must, with a name of small letters, digits, - and _",
        )
    try:
        return points[0].load()(*arguments)
    except Exception as error:
        raise ConfigError(
            "plugin.unusable", f"the entry point {points[0].value} of {group} cannot be loaded: {error!r}"
        ) from error
