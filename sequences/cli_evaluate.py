"""The command `skyfix evaluate`; `sequences.cli` lists it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sequences.cli_options import (
    BackendOption,
    HalfExtentOption,
    HalfHeadingsOption,
    HeadingUnknownOption,
    JsonOption,
    MaxFramesOption,
    PickleOption,
    SeedOption,
    write_json,
    write_text,
)


def evaluate(
    sequences: Annotated[
        list[Path], typer.Argument(help="Drives with ground truth, lists of frames.", metavar="SEQUENCE")
    ],
    matcher: Annotated[
        list[str] | None,
        typer.Option(
            help="As for track; give it several times to compare. Default: rotmatch and geometric; with --backend "
            "rotmatch.",
            metavar="NAME|FILE",
        ),
    ] = None,
    backend: BackendOption = None,
    half_extent: HalfExtentOption = 20.0,
    half_heading_deg: HalfHeadingsOption = None,
    heading_unknown: HeadingUnknownOption = False,
    max_frames: MaxFramesOption = 200,
    seed: SeedOption = 0,
    allow_pickle: PickleOption = False,
    json_file: JsonOption = None,
    markdown_file: Annotated[
        Path | None,
        typer.Option("--markdown", help="Also write the table, with a legend, to this file.", metavar="FILE"),
    ] = None,
) -> None:
    """Score single shots: each scan by itself from a start that is off, beside the prior's own score.

    Frames of a list (KITTI + aerial) start where the list says, whatever the options.
    """
    from learned.matcher import load_matcher
    from sequences.evaluate import evaluate_frames, evaluate_single_shot
    from sequences.evaluation_tables import markdown_page, markdown_table, matcher_labels
    from sequences.frame_set import FrameSet
    from sequences.registry import OpenOptions, open_any
    from sequences.shot_protocol import ShotProtocol

    headings = list(half_heading_deg or ([] if heading_unknown else [10.0])) + ([180.0] if heading_unknown else [])
    protocols = [ShotProtocol(half_extent, heading, max_frames, seed) for heading in dict.fromkeys(headings)]
    labels = matcher_labels(matcher or (["rotmatch", "geometric"] if backend is None else ["rotmatch"]))
    if backend is not None:
        labels = {f"{label} ({backend})": name for label, name in labels.items()}
    loaded = {label: load_matcher(name, backend) for label, name in labels.items()}
    evaluations = []
    for path in sequences:
        opened = open_any(path, OpenOptions(seed, allow_pickle))
        if isinstance(opened, FrameSet):
            evaluations.append(evaluate_frames(opened, loaded, max_frames))
        else:
            evaluations += [evaluate_single_shot(opened, loaded, protocol) for protocol in protocols]
    typer.echo(markdown_table(evaluations), nl=False)
    write_json(json_file, evaluations)
    write_text(markdown_file, markdown_page(evaluations, labels))
