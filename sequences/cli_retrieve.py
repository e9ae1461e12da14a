"""The commands `skyfix retrieve` and `train-places`; `sequences.cli` lists them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from fusion.errors import SkyfixError
from sequences.cli_options import (
    CacheOption,
    ExtractsOption,
    JsonOption,
    MaxFramesOption,
    SeedOption,
    write_json,
    write_text,
)


def retrieve(
    sequence: Annotated[Path, typer.Argument(help="Any drive that track opens.", metavar="SEQUENCE")],
    index_file: Annotated[
        Path | None,
        typer.Option("--index", help="Read the map's index from this file, or make it and write it.", metavar="FILE"),
    ] = None,
    matcher: Annotated[
        str,
        typer.Option(help="Whose features are looked up: rotmatch (shipped) or a checkpoint of it.", metavar="FILE"),
    ] = "rotmatch",
    embedding: Annotated[
        Path | None,
        typer.Option(help="Of these features, by `skyfix train-places`. Default: the shipped one.", metavar="FILE"),
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
    from learned.matcher import load_matcher
    from learned.place_embedding import PlaceEmbedding
    from learned.retrieval import Retriever
    from learned.rotmatch import RotMatch
    from sequences.registry import OpenOptions, open_sequence
    from sequences.retrieval import RECALL_AT, index_of, look_up, places_csv, summary_of, summary_table

    if not 1 <= top <= max(RECALL_AT):
        raise SkyfixError(f"top: expected 1 to {max(RECALL_AT)} places, got {top}")
    network = load_matcher(matcher)
    if not isinstance(network, RotMatch):
        raise SkyfixError(f"--matcher: expected rotmatch or a checkpoint of it, got {matcher}")
    retriever = Retriever(network, None if embedding is None else PlaceEmbedding.load(embedding))
    opened = open_sequence(sequence, OpenOptions(seed))
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


def train_places(
    config: Annotated[
        Path,
        typer.Argument(help="YAML file of a training that simulates scans to 72 m.", metavar="CONFIG"),
    ],
    out: Annotated[Path, typer.Option(help="File to write, .safetensors.", metavar="FILE")],
    data: ExtractsOption = Path(),
    matcher: Annotated[
        str, typer.Option(help="Whose features: rotmatch (shipped) or a checkpoint of it.", metavar="FILE")
    ] = "rotmatch",
    scans_per_area: Annotated[
        int, typer.Option(help="Of each neighbourhood that CONFIG simulates, use so many scans.", metavar="N")
    ] = 4,
    cache: CacheOption = None,
    seed: Annotated[int, typer.Option(help="Of batches and of where places are shown. Same seed, same weights.")] = 0,
) -> None:
    """Train an embedding of places, for `retrieve`, on scans simulated in OpenStreetMap extracts.

    The network itself stays as it is; an embedding is of the features of one network alone.
    """
    from learned.place_training import PlaceTraining
    from sequences.train_places import PlaceOptions, train_embedding

    options = PlaceOptions(matcher, scans_per_area, cache, PlaceTraining(seed=seed))
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("scans", total=None)
        facts = train_embedding(
            config, data, out, options, lambda done, total: bar.update(task, completed=done, total=total)
        )
    found = facts["validation"]
    shares = ", ".join(f"{100 * share:.0f} % among the best {k}" for k, share in found["recall"].items())
    typer.echo(f"embedding: {out}; of {found['places']} unseen scans and their places, its own is {shares}")
