"""``timberhand compile``: compile the controller's tick ahead of time."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer

from timberhand.commands.options import JsonOption


def compile_tick(
    force: Annotated[bool, typer.Option("--force", help="Compile again, even if the build is ready.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compile the controller's tick ahead of time, into build/compiled.

    Takes about a minute, once for each state of the sources. From then on
    `python -m controller` runs the compiled tick; TIMBERHAND_COMPILED=0 or
    --interpreter keeps it on the interpreter. Exit code 3 when gcc or mypyc is
    missing: everything works without.
    """
    from host.compiled.build import compile_tick as build

    answer = build(lambda stage: print(f"compile: {stage}", file=sys.stderr, flush=True), force)
    if as_json:
        print(json.dumps(answer))
    elif answer["new"]:
        print(f"compiled {answer['modules']} modules in {answer['seconds']:.0f} s: build {answer['key']}")
    else:
        print(f"build {answer['key']} is ready")
