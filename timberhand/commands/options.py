"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

ProfileOption = Annotated[str, typer.Option("--profile", help="Machine profile: a shipped name or a TOML file.")]
TruthOption = Annotated[
    str, typer.Option("--truth", help="Hidden ground truth of the plant: nominal, sampled, or a TOML file.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
SummaryOption = Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")]
PageOption = Annotated[bool, typer.Option("--console/--no-console", help="Serve the operator's page (live).")]
PagePortOption = Annotated[int, typer.Option("--console-port", help="Port of the operator's page on localhost.")]
MaxStopsOption = Annotated[
    int, typer.Option("--max-stops", help="Stops after which the emulated operator gives up (live).")
]
