"""Over how far does RotMatch repeat an error, on maps that show more or less? Simulated drives through Helsinki.

    python -m benchmarks.error_correlation --worlds 6

The same streets in several drawn worlds (`benchmarks.drawn_drives`), a scan every few metres, each matched by itself
within 20 m and 10 degrees with three maps of the same world. The maps as a whole are not shifted against the world:
that never decorrelates and is `TrackSettings.map_error_m`. 'Prior only' answers the middle of the search.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import typer
from rich.progress import track

from benchmarks.command import run
from benchmarks.drawn_drives import DrawnDrive
from fusion.arrays import FloatArray
from fusion.error_correlation import estimate_error_correlation
from learned.answers import match_scan
from learned.matcher import MapMatcher, SearchRegion, load_matcher
from sequences.measurement import best_pose
from sequences.metrics import distance_along, vehicle_frame_errors

_HALF_EXTENT_M, _HALF_HEADING_RAD = 20.0, math.radians(10.0)
_OFF = np.array([12.0, 12.0, math.radians(8.0)])
"""Searches are centred up to so far from the truth."""
_REACH_M = 120.0
_STREAM = 4


def main(
    worlds: Annotated[int, typer.Option(min=1, help="Drawn worlds, the demo's first.", metavar="N")] = 6,
    every_m: Annotated[float, typer.Option(min=0.5, help="A scan every so many metres.", metavar="M")] = 4.0,
) -> None:
    """Print a table: for each kind of map how far off single shots are, and over how far they repeat an error."""
    matcher = load_matcher("rotmatch")
    drives = [_errors(matcher, number, every_m) for number in track(range(worlds), description="worlds")]
    typer.echo(f"{sum(len(along) for along, _ in drives)} simulated scans in {worlds} worlds, {matcher.name}\n")
    typer.echo("| map | median error m | within 1 m | errors repeat over m (1/e) |\n|---|--:|--:|--:|")
    of_drive = np.repeat(np.arange(worlds), [len(along) for along, _ in drives])
    travelled = np.concatenate([along for along, _ in drives])
    for kind in drives[0][1]:
        errors = np.concatenate([of_kind[kind] for _, of_kind in drives])
        found = estimate_error_correlation(errors, travelled, max_distance_m=_REACH_M, drives=of_drive)
        off = np.hypot(errors[:, 0], errors[:, 1])
        typer.echo(f"| {kind} | {np.median(off):.2f} | {100 * np.mean(off < 1.0):.0f} % | {found.length_m:.0f} |")


def _errors(matcher: MapMatcher, number: int, every_m: float) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Distance travelled (N,) and, by the map's kind, errors (N, 3) along the vehicle of prior and single shots."""
    drive, rng = DrawnDrive(number, map_offset_m=0.0), np.random.default_rng((number, _STREAM))
    along = distance_along(drive.ground_truth.poses)
    frames = np.unique(np.searchsorted(along, np.arange(0.0, along[-1], every_m)))
    truth = drive.ground_truth.poses[frames]
    centres = truth + rng.uniform(-_OFF, _OFF, truth.shape)
    found: dict[str, list[FloatArray]] = {"prior only": list(centres), **{kind: [] for kind in drive.maps}}
    for frame, centre in zip(frames.tolist(), centres, strict=True):
        points, search = drive.scan(frame), SearchRegion(centre, _HALF_EXTENT_M, _HALF_HEADING_RAD)
        for kind, shown in drive.maps.items():
            found[kind].append(best_pose(match_scan(matcher, points, drive.ground_z, shown, search)))
    errors = {kind: vehicle_frame_errors(truth, np.array(poses)) for kind, poses in found.items()}
    return along[frames], {kind: np.column_stack(columns) for kind, columns in errors.items()}


if __name__ == "__main__":
    run(main, "error_correlation")
