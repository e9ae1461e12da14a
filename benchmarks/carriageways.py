"""Tracking on maps of carriageways alone, by how far errors are taken to repeat. Simulated drives through Helsinki.

    python -m benchmarks.carriageways --worlds 5

Each drive of 2 km is in a drawn world of its own (`benchmarks.drawn_drives`), its map shifted against the world. It is
tracked as `skyfix track` does, with scans that are simulated and odometry that is emulated, for every length given.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.progress import track as progress

from benchmarks.command import run
from benchmarks.drawn_drives import CARRIAGEWAYS, DrawnDrive
from learned.matcher import load_matcher
from sequences.localize import track
from sequences.over_seeds import cell, markdown_table, over_seeds
from sequences.track_settings import TrackSettings

_LENGTHS_M = (6.0, 25.0)
_SAME = {"prior": "prior", "odometry": "odometry only (emulated)"}
_METHODS = {
    "single_shot": "single shot",
    "filter": "filter",
    "filter_after_first_quarter": "filter after a quarter",
    "smoother": "smoother",
}
_COLUMNS: dict[str, tuple[str, float]] = {
    "mean m": ("position_error_m.mean", 1),
    "heading mean °": ("heading_error_deg.mean", 1),
    "in the 95 % ellipse %": ("ellipse95", 100),
    "NEES (3 expected)": ("nees.mean", 1),
}


def main(
    worlds: Annotated[int, typer.Option(min=1, help="Drawn worlds, the demo's first.", metavar="N")] = 5,
    length_m: Annotated[list[float] | None, typer.Option(help="Errors repeat over so much.", metavar="M")] = None,
) -> None:
    """Print a table: errors and consistency, mean and standard deviation over the worlds."""
    lengths = length_m or list(_LENGTHS_M)
    matcher = load_matcher("rotmatch")
    runs: dict[float, list[dict[str, Any]]] = {length: [] for length in lengths}
    for number in progress(range(worlds), description="worlds"):
        drive = DrawnDrive(number, kind=CARRIAGEWAYS)
        for length in lengths:
            settings = TrackSettings("emulated", seed=number, correlation_length_m=length, snapshots=0)
            runs[length].append(track(drive, matcher, settings).metrics)
    rows = [_row(label, "-", runs[lengths[0]], method) for method, label in _SAME.items()]
    rows += [
        _row(label, f"{length:g}", runs[length], method) for method, label in _METHODS.items() for length in lengths
    ]
    typer.echo(f"{worlds} worlds, {matcher.name}, scans simulated, maps of carriageways alone\n")
    typer.echo(markdown_table(["method", "errors repeat over m", *_COLUMNS], rows, left=1), nl=False)


def _row(label: str, length: str, metrics: list[dict[str, Any]], method: str) -> list[str]:
    found = over_seeds([each[method] for each in metrics])
    return [label, length, *(cell(found.get(key), unit) for key, unit in _COLUMNS.values())]


if __name__ == "__main__":
    run(main, "carriageways")
