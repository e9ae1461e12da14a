"""The command `skyfix retrieve`; `sequences.cli` lists it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sequences.cli_options import JsonOption, MaxFramesOption, SeedOption, write_json


def retrieve(
    sequence: Annotated[Path, typer.Argument(help="Any drive with ground truth that track opens.", metavar="SEQUENCE")],
    index_file: Annotated[
        Path | None,
        typer.Option("--index", help="Read the map's index from this file, or make it and write it.", metavar="FILE"),
    ] = None,
    shortlist: Annotated[
        int, typer.Option(help="Places that are looked at again with the network's vote.", metavar="N")
    ] = 1000,
    max_frames: MaxFramesOption = 200,
    seed: SeedOption = 0,
    json_file: JsonOption = None,
) -> None:
    """Look a drive's scans up on its whole map, nothing known beforehand: how often is the right 64 m tile found?"""
    from learned.retrieval import Retriever
    from learned.rotmatch import RotMatch
    from sequences.registry import OpenOptions, open_sequence
    from sequences.retrieval import index_of, recall_table, score_retrieval

    opened, retriever = open_sequence(sequence, OpenOptions(seed)), Retriever(RotMatch.shipped())
    index = index_of(opened, retriever, index_file)
    scores = score_retrieval(opened, retriever, index, max_frames, shortlist)
    typer.echo(recall_table(scores), nl=False)
    write_json(json_file, scores)
