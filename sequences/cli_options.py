"""What the commands of `skyfix` have in common: options, the line of a training step, writing files."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from fusion.errors import SkyfixError

MatcherOption = Annotated[
    str,
    typer.Option(
        help="Matches scans with the map: rotmatch (learned, shipped), pooled (another network beside it: twice the "
        "time, fewer mistakes), geometric (no learning), a .safetensors file, a folder of `skyfix export`, or one of "
        "your own: FILE.py:NAME, MODULE:NAME.",
        metavar="NAME|FILE",
    ),
]
BackendOption = Annotated[
    str | None,
    typer.Option(
        help="Runs rotmatch's encoders: torch, openvino, openvino-bf16, openvino-int8, onnxruntime or "
        "onnxruntime-int8; those of int8 need a folder of `skyfix export --int8`. Default: torch, or for a folder the "
        "first that is installed.",
        metavar="NAME",
    ),
]
SeedOption = Annotated[int, typer.Option(help="Of start, particles and simulated scans. Same seed, same numbers.")]
OutOption = Annotated[
    Path | None, typer.Option(help="Run directory to write. Default: runs/SEQUENCE-ODOMETRY-seedN.", metavar="DIR")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the run that is in the directory.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
HeadingUnknownOption = Annotated[
    bool, typer.Option("--heading-unknown", help="The start's heading may be anything, as with --half-heading-deg 180.")
]
ExtractsOption = Annotated[Path, typer.Option(help="Folder of the OpenStreetMap extracts.", metavar="DIR")]
CacheOption = Annotated[
    Path | None,
    typer.Option(
        help="Keep the simulated samples here, for other runs of the same simulation too. Default: OUT/cache.",
        metavar="DIR",
    ),
]
StartAnywhereOption = Annotated[
    bool,
    typer.Option(
        "--start-anywhere",
        help="Nothing is known of the start, not even the heading: it is looked for on the whole map.",
    ),
]
WatchMapOption = Annotated[
    float,
    typer.Option(
        "--watch-map-every",
        help="Compare a scan with the whole map every so many metres, to notice that the vehicle was carried "
        "elsewhere; 4 notices it soon. Doubles the cost, and raises false alarms on maps that show little. "
        "0: only for 100 m after it was looked for on the whole map.",
        metavar="M",
    ),
]
HalfExtentOption = Annotated[
    float, typer.Option(help="The start is known to within a square of this half side, metres.", metavar="M")
]
HalfHeadingOption = Annotated[
    float, typer.Option(help="The start's heading is known to within this, degrees; at most 180.", metavar="DEG")
]
HalfHeadingsOption = Annotated[
    list[float] | None,
    typer.Option(
        help="As for track; give it several times to compare starts, 180 for an unknown heading. Default: 10.",
        metavar="DEG",
    ),
]
MaxFramesOption = Annotated[int, typer.Option(help="Most scans of a sequence, spread evenly.", metavar="N")]
PickleOption = Annotated[
    bool, typer.Option("--allow-pickle", help="Unpickle scans (CARLA's), which runs code of whoever made the files.")
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Also write the numbers to this file.", metavar="FILE")]


def seed_numbers(text: str) -> tuple[int, ...]:
    """The seeds that an option lists; `SkyfixError` if they are not whole numbers between commas."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise SkyfixError(f"--seeds: expected whole numbers between commas, got {text!r}") from error


def training_line(step: int, steps: int, loss: float, validation: float | None) -> None:
    """Show a training step on standard error, now and then."""
    if step % 50 == 0 or step == steps:
        held_out = "" if validation is None else f", validation {validation:.3f}"
        print(f"step {step}/{steps}: loss {loss:.3f}{held_out}", file=sys.stderr)


def write_json(path: Path | None, content: object) -> None:
    """Write to a file that an option named, if it did.

    Raises
    ------
    SkyfixError
        If it cannot be written.
    """
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, or say in one line why not."""
    try:
        path.write_bytes(content)
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be written: {error.strerror}") from error


def write_text(path: Path | None, content: str) -> None:
    """As `write_json`, text as it is."""
    if path is None:
        return
    try:
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be written: {error.strerror}") from error
