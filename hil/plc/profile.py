"""The profile of a machine with a PLC between crane0 and its valves."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final, Literal

from controller.guard.__main__ import profile_path
from machine.loading.beside import carry_envelope

PLC_DELAY_S: Final = 0.04
"""Delay that bridge, exchange and PLC cycle add to every valve: 10 ms each way, and two cycles between."""
_DELAY: Final = re.compile(r"^delay_s = ([0-9.]+)", re.MULTILINE)


def write_plc_profile(name: str, role: Literal["references", "valves"], directory: Path) -> Path:
    """Write ``NAME_plc.toml`` into a directory, from the name of a shipped profile or a file.

    The valve delays of the joints grow by `PLC_DELAY_S`: the controller uses them to lead its references and to monitor
    whether a joint follows its command.
    """
    text = _DELAY.sub(lambda found: f"delay_s = {float(found[1]) + PLC_DELAY_S:g}", profile_path(name).read_text())
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{Path(name).stem}_plc.toml"
    path.write_text(f'{text}\n# The machine PLC on Ethernet\n[plc]\nrole = "{role}"\n')
    carry_envelope(profile_path(name), directory)
    return path
