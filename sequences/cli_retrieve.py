"""The command `skyfix retrieve`; `sequences.cli` lists it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusion.errors import SkyfixError
from sequences.cli_options import JsonOption, MaxFramesOption, SeedOption, write_json, write_text


def retrieve(
    sequence: Annotated[Path, typer.Argument(help="Any drive that track opens.", metavar="SEQUENCE")],
    index_file: Annotated[
        Path | None,
        typer.Option("--index", help="Read the map's index from this file, or make it and write it.", metavar="FILE"),
    ] = None,
    shortlist: Annotated[
        int, typer.Option(help="Places that are looked at again with the network's vote.", metavar="N")
    ] = 1000,
    max_frames: MaxFramesOption = 200,
    seed: SeedOption = 0,
    places_file: Annotated[
        Path | None,
        typer.Option("--places", help="Write each scan's best places to this file, CSV.", metavar="FILE"),
    ] = None,
    top: Annotated[int, typer.Option(help="That many places a scan, at most 100.", metavar="N")] = 10,
    json_file: JsonOption = None,
) -> None:
    """Look a drive's scans up on its whole map, nothing known beforehand.

    The places are written with --places. Where there is ground truth: how often is the right 64 m tile found?
    """
    from learned.retrieval import Retriever
    from learned.rotmatch import RotMatch
    from sequences.registry import OpenOptions, open_sequence
    from sequences.retrieval import RECALL_AT, index_of, look_up, places_csv, summary_of, summary_table

    if not 1 <= top <= max(RECALL_AT):
        raise SkyfixError(f"top: expected 1 to {max(RECALL_AT)} places, got {top}")
    opened, retriever = open_sequence(sequence, OpenOptions(seed)), Retriever(RotMatch.shipped())
    if opened.ground_truth is None and places_file is None:
        raise SkyfixError(
            f"{opened.name}: expected ground truth to score places against, or --places FILE; got neither"
        )
    index = index_of(opened, retriever, index_file)
    answers = look_up(opened, retriever, index, max_frames, shortlist)
    summary = summary_of(opened, index, answers)
    typer.echo(summary_table(summary), nl=False)
    write_json(json_file, summary)
    if places_file is not None:
        write_text(places_file, places_csv(answers, top))
