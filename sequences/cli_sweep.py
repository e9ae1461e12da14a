"""The command `skyfix sweep`; `sequences.cli` lists it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from sequences.cli_options import QuietOption, seed_numbers


def sweep(
    sequences: Annotated[
        list[Path],
        typer.Argument(help="Drives with ground truth, as for track; `demo` is one.", metavar="SEQUENCE..."),
    ],
    odometry: Annotated[
        list[str] | None,
        typer.Option(
            help="Of each drive, those of these that it has; may be repeated. Default: all that are not emulated, or "
            "all where all are.",
            metavar="NAME",
        ),
    ] = None,
    matcher: Annotated[
        list[str] | None, typer.Option(help="As for track; may be repeated.", metavar="NAME|FILE")
    ] = None,
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Any setting that a run's config.yaml lists; a list of values, [V, V], is swept, every combination "
            "with the other lists. May be repeated.",
            metavar="KEY=VALUE|LIST",
        ),
    ] = None,
    seeds: Annotated[str, typer.Option(help="Track everything with each of these.", metavar="N,N,...")] = "0",
    out: Annotated[Path, typer.Option(help="Gets the tables and every run.", metavar="DIR")] = Path("runs/sweep"),
    jobs: Annotated[int, typer.Option(help="So many runs at once.", metavar="N")] = 1,
    quiet: QuietOption = False,
) -> None:
    """Track drives with every odometry, matcher, setting and seed asked for, and compare them in one table.

    Writes OUT/sweep.md, sweep.json and sweep.png anew after every run, and a run directory for each below OUT/runs.
    Goes on where it was stopped.
    """
    from sequences.sweep import sweep as run_sweep
    from sequences.sweep_plan import SweepOptions

    options = SweepOptions(
        tuple(odometry or ()), tuple(matcher or ("rotmatch",)), seed_numbers(seeds), tuple(override or ())
    )
    table = run_sweep(
        sequences, options, out, jobs=jobs, quiet=quiet, report=lambda line: None if quiet else _say(line)
    )
    typer.echo(table.read_text(encoding="utf-8"), nl=False)


def _say(line: str) -> None:
    print(line, file=sys.stderr)
