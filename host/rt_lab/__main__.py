"""Command line of the lab: ``python -m host.rt_lab``, the same as ``timberhand hil rt-lab``.

Exit status: 0 every check passed; 2 usage; 4 it cannot run here; 6 a check failed.
"""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import ExitCode
from host.vcan_lab.spec import LabError


class Accelerator(StrEnum):
    """How qemu runs the guest."""

    TCG = "tcg"
    KVM = "kvm"


def rt_lab(
    kernel: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Debian package of a PREEMPT_RT kernel (default: linux-image-rt-amd64)."),
    ] = None,
    accel: Annotated[
        Accelerator, typer.Option(help="tcg emulates and runs anywhere; kvm is faster where it works.")
    ] = Accelerator.TCG,
    timeout: Annotated[float, typer.Option(metavar="S", min=1.0, help="Give up after this time.")] = 600.0,
) -> None:
    """Check the control loop on Debian's PREEMPT_RT kernel, in qemu.

    Boots the kernel with this checkout, vcan and emulated nodes; checks that
    controller and guard run at their priorities with locked memory, and that
    the valves are neutral after the controller is killed. Shows that it works,
    and nothing about latency. The result is JSON on stdout.

    Examples:

      timberhand hil rt-lab

      timberhand hil rt-lab --accel kvm --kernel linux-image-rt.deb
    """
    from host.rt_lab.host import evaluate, run

    try:
        result = run(kernel, accel.value, timeout, lambda line: print(f"rt lab: {line}", file=sys.stderr, flush=True))
    except LabError as error:
        print(f"rt lab: {error} [{error.code}]", file=sys.stderr)
        raise typer.Exit(ExitCode.BUS) from None
    faults = evaluate(result)
    print(json.dumps(result | {"failed": faults}, indent=2))
    for sentence in faults or ["all checks passed"]:
        print(f"rt lab: {sentence}", file=sys.stderr)
    raise typer.Exit(ExitCode.FIGURE_MISSED if faults else ExitCode.OK)


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(rt_lab)
    app()
