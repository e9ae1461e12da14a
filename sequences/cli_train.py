"""The commands `skyfix train` and `export`; `sequences.cli` lists them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sequences.cli_options import CacheOption, ExtractsOption, SeedOption, training_line


def train(
    config: Annotated[Path, typer.Argument(help="YAML file with the training's settings.", metavar="CONFIG")],
    data: ExtractsOption = Path(),
    out: Annotated[Path, typer.Option(help="Gets the checkpoint, the loss curve and the cache.", metavar="DIR")] = Path(
        "runs/training"
    ),
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="Replace a setting of CONFIG, as in training.steps=500; may be repeated.", metavar="KEY=VALUE"
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            help="Time a few steps and set the number of steps to take about so long in all; a resumed run keeps its.",
            metavar="M",
        ),
    ] = None,
    cache: CacheOption = None,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Also write the losses as TensorBoard event files into OUT.")
    ] = False,
    initial: Annotated[
        Path | None,
        typer.Option(
            help="Start from the weights of this checkpoint: of the same architecture, or of one that pre-trains it.",
            metavar="CHECKPOINT",
        ),
    ] = None,
    average: Annotated[
        list[Path] | None,
        typer.Option(
            help="Average these weights with the trained ones, by CONFIG's averaged_shares; may be repeated.",
            metavar="CHECKPOINT",
        ),
    ] = None,
) -> None:
    """Train a network on scans simulated in OpenStreetMap extracts; goes on where it was stopped.

    CONFIG says which network and how. Under torchrun, all its processes train one network together.
    """
    from sequences.train_command import TrainOptions, train_from_config

    options = TrainOptions(tuple(override or ()), minutes, cache, tensorboard, initial, tuple(average or ()))
    checkpoint = train_from_config(config, data, out, training_line, options)
    if os.environ.get("RANK", "0") == "0":  # of the processes that torchrun starts, the first speaks
        typer.echo(f"checkpoint: {checkpoint}")


def export(
    checkpoint: Annotated[
        str, typer.Argument(help="rotmatch (shipped) or a .safetensors file of it.", metavar="CHECKPOINT")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write.", metavar="DIR")],
    int8: Annotated[
        Path | None,
        typer.Option(
            help="Also write 8-bit graphs, with ranges taken from this drive with ground truth, or from the demo.",
            metavar="SEQUENCE|demo",
        ),
    ] = None,
    frames: Annotated[int, typer.Option(help="Scans of the drive to take ranges from.", metavar="N")] = 16,
    seed: SeedOption = 0,
) -> None:
    """Write RotMatch's encoders as ONNX graphs, for `--matcher DIR` with a quicker runtime than torch."""
    from learned.export import export as write_export
    from learned.matcher import load_matcher
    from learned.rotmatch import RotMatch
    from sequences.matched_images import matched_images
    from sequences.registry import OpenOptions, open_sequence

    matcher = load_matcher(checkpoint, "torch")
    images = []
    if int8 is not None and isinstance(matcher, RotMatch):
        images = matched_images(open_sequence(int8, OpenOptions(seed)), matcher, frames)
    typer.echo(f"export: {write_export(matcher, out, images)}")
