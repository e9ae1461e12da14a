"""The command `skyfix ablate`; `sequences.cli` lists it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from sequences.cli_options import (
    CacheOption,
    ExtractsOption,
    HalfExtentOption,
    HalfHeadingsOption,
    MaxFramesOption,
    seed_numbers,
    training_line,
)


def ablate(
    config: Annotated[
        Path, typer.Argument(help="YAML file with a base configuration and its variants.", metavar="CONFIG")
    ],
    data: ExtractsOption = Path(),
    out: Annotated[Path, typer.Option(help="Gets the tables and every run.", metavar="DIR")] = Path("runs/ablation"),
    minutes: Annotated[
        float | None,
        typer.Option(
            help="Choose the number of steps so that the first run takes about so long; all runs take as many. "
            "A resumed ablation keeps its.",
            metavar="M",
        ),
    ] = None,
    seeds: Annotated[str, typer.Option(help="Train every variant with each of these.", metavar="N,N,...")] = "0",
    evaluate: Annotated[
        list[Path] | None,
        typer.Option(
            help="Also score every network on the scans of this sequence folder, which has ground truth; may be "
            "repeated.",
            metavar="SEQUENCE",
        ),
    ] = None,
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="Replace a setting of the base, for all variants; may be repeated.", metavar="KEY=VALUE"
        ),
    ] = None,
    cache: CacheOption = None,
    half_extent: HalfExtentOption = 20.0,
    half_heading_deg: HalfHeadingsOption = None,
    max_frames: MaxFramesOption = 200,
) -> None:
    """Train the variants of a network with several seeds and compare them; goes on where it was stopped.

    Writes OUT/ablation.md and OUT/ablation.json anew after every run. Without --half-heading-deg, the heading is
    known to within what the base trains for.
    """
    from sequences.ablate import AblateOptions
    from sequences.ablate import ablate as run_ablation
    from sequences.registry import open_sequence

    opened = [open_sequence(path) for path in evaluate or []]
    options = AblateOptions(
        seed_numbers(seeds),
        minutes,
        cache,
        tuple(override or ()),
        half_extent,
        tuple(half_heading_deg or ()),
        max_frames,
    )
    table = run_ablation(config, data, out, opened, options, training_line, lambda line: print(line, file=sys.stderr))
    typer.echo(table.read_text(encoding="utf-8"), nl=False)
