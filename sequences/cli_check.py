"""The command `skyfix check`; `sequences.cli` lists it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sequences.cli_options import MatcherOption, PickleOption, SeedOption, write_bytes


def check(
    sequence: Annotated[Path, typer.Argument(help="Any drive that track opens.", metavar="SEQUENCE")],
    matcher: MatcherOption = "rotmatch",
    picture: Annotated[
        Path | None, typer.Option(help="Draw its paths and a few scans over the map.", metavar="FILE.png")
    ] = None,
    seed: SeedOption = 0,
    allow_pickle: PickleOption = False,
) -> None:
    """Look at a drive before tracking it: times, axes, units, the ground's height, what the map covers and shows.

    With ground truth a few scans are also matched about it. Exit code 1 when there is a problem.
    """
    from learned.matcher import load_matcher
    from sequences.check import Level, looked_at
    from sequences.check import check as check_drive
    from sequences.registry import OpenOptions, open_sequence

    opened = open_sequence(sequence, OpenOptions(seed, allow_pickle))
    findings = check_drive(opened, load_matcher(matcher))
    for finding in findings:
        typer.echo(f"{finding.level:<8} {finding.subject}: {finding.text}")
    if picture is not None:
        from sequences.figures.check import check_figure
        from sequences.figures.style import png_bytes

        write_bytes(picture, png_bytes(check_figure(opened, looked_at(opened)[0])))
        typer.echo(f"picture: {picture}")
    if any(finding.level is Level.PROBLEM for finding in findings):
        raise typer.Exit(1)
