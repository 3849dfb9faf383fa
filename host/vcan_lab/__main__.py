"""Command line of the lab: ``python -m host.vcan_lab -- COMMAND``, the same as ``timberhand hil vcan -- COMMAND``.

Exit status: that of the command; 124 timeout; 126, 127 the command cannot be started; 2 usage; 4 no lab available.
"""

from __future__ import annotations

import json
import os
from enum import StrEnum
from typing import Annotated

import typer

from host.exit_codes import ExitCode
from host.vcan_lab.spec import DEFAULT_BOOT_TIMEOUT_S, DEFAULT_LINKS, DEFAULT_MEM_MB, LabError, Request, link_fault

CONTEXT = {"allow_interspersed_args": False}
"""The first word of the command ends the options of the lab, with or without ``--``."""


class Kernel(StrEnum):
    """A user-mode kernel."""

    DEBIAN = "debian"
    LAB = "lab"


def vcan(
    command: Annotated[list[str] | None, typer.Argument(metavar="COMMAND [ARG]...", show_default=False)] = None,
    link: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Further interface besides vcan0 and vcan1; may be repeated."),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.001, help="Time limit of the command; exit status 124 when exceeded."),
    ] = None,
    mem: Annotated[int, typer.Option(metavar="MB", min=128, help="Memory of the user-mode kernel.")] = DEFAULT_MEM_MB,
    root: Annotated[bool, typer.Option("--root", help="Be root inside; files still belong to the caller.")] = False,
    kernel: Annotated[
        Kernel | None, typer.Option(help="Force this user-mode kernel; lab is built by `make lab-kernel`.")
    ] = None,
    time_travel: Annotated[
        bool, typer.Option("--time-travel", help="Simulated time, with the lab kernel: waiting takes no time.")
    ] = False,
    boot_timeout: Annotated[
        float, typer.Option(metavar="S", min=0.001, help="Time limit until the interfaces are ready.")
    ] = DEFAULT_BOOT_TIMEOUT_S,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print method, boot time and memory.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Print the method that would be used and why; run nothing.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --check: as JSON.")] = False,
) -> None:
    """Run a command with SocketCAN interfaces vcan0 and vcan1, on any Linux kernel.

    Natively where the kernel has CAN, else in user-mode Linux on this machine's
    own files: no root, a second to boot, nothing left behind. Standard input is
    empty; the network is the loopback alone.

    Examples:

      timberhand hil vcan -- candump -n 1 vcan0

      timberhand hil vcan --timeout 120 -v -- python -m pytest tests/live/vcan

      timberhand hil vcan --link crane0 --link mach0 -- ip -brief link

      timberhand hil vcan --time-travel -- sleep 3600
    """
    from host.vcan_lab.choose import choose, survey
    from host.vcan_lab.host import run

    if not command and not check:
        raise typer.BadParameter("no command given; write it after --", param_hint="COMMAND")
    if time_travel and kernel is Kernel.DEBIAN:
        raise typer.BadParameter("Debian's kernel has no simulated time; omit --kernel", param_hint="--kernel")
    for name in link or ():
        if fault := link_fault(name):
            raise typer.BadParameter(fault, param_hint="--link")
    request = Request(
        argv=tuple(command or ()),
        cwd=os.getcwd(),
        env=dict(os.environ),
        uid=os.getuid(),
        gid=os.getgid(),
        groups=tuple(os.getgroups()),
        umask=_umask(),
        links=tuple(dict.fromkeys((*DEFAULT_LINKS, *(link or ())))),
        root=root,
        mem_mb=mem,
        timeout_s=timeout,
        boot_timeout_s=boot_timeout,
        kernel="lab" if time_travel or kernel is Kernel.LAB else "debian" if kernel is Kernel.DEBIAN else None,
        time_travel=time_travel,
    )
    try:
        method = choose(survey(request), request.kernel)
        if check:
            method_facts = {"way": method.kind, "why": method.reason, "kernel": method.kernel, "links": request.links}
            typer.echo(json.dumps(method_facts) if as_json else f"{method.kind}: {method.reason}")
            return
        if verbose:
            typer.echo(f"vcan lab: {method.kind}: {method.reason}", err=True)
        status = run(request, method, verbose)
    except LabError as error:
        if check and as_json:
            typer.echo(
                json.dumps({"way": None, "why": str(error), "code": error.code, "kernel": None, "links": request.links})
            )
        else:
            typer.echo(f"vcan lab: {error} [{error.code}]", err=True)
        status = ExitCode.BUS
    raise typer.Exit(status)


def _umask() -> int:
    umask = os.umask(0o077)
    os.umask(umask)
    return umask


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command(context_settings=CONTEXT)(vcan)
    app()
