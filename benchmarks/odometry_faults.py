"""Tracking when the odometry fails: gaps, jumps and frozen poses put into the odometry of a good drive.

    python -m benchmarks.odometry_faults --sequence drives/kitti360_0009 --seeds 0,1,2

Scans, map and truth are the drive's. Faults begin after three tenths of the drive's time. "Odometry only" is the faulty
one as it comes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track as progress

from benchmarks.command import run
from fusion import se2
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from learned.matcher import load_matcher
from sequences.cli_options import seed_numbers
from sequences.cli_track import default_odometry
from sequences.localize import track
from sequences.over_seeds import cell, markdown_table, over_seeds
from sequences.registry import open_sequence
from sequences.sequence import Sequence, odometry_is_emulated
from sequences.track_settings import TrackSettings

Fault = Callable[[Trajectory], Trajectory]

_BEGIN = 0.3  # of the drive's time
_SMALL_JUMP, _LARGE_JUMP = (5.0, 3.0, 0.1), (300.0, 0.0, 0.0)
_METHODS = {"prior": "prior", "odometry": "odometry only", "filter": "filter", "smoother": "smoother"}
_COLUMNS: dict[str, tuple[str, float]] = {
    "mean m": ("position_error_m.mean", 1),
    "max m": ("position_error_m.max", 1),
    "heading mean °": ("heading_error_deg.mean", 1),
    "in the 95 % ellipse %": ("ellipse95", 100),
    "NEES (3 expected)": ("nees.mean", 1),
}


def without(seconds: float) -> Fault:
    """No odometry for a while; afterwards it knows where it is."""

    def fault(odometry: Trajectory) -> Trajectory:
        inside = _during(odometry, seconds)
        return Trajectory(odometry.stamp_ns[~inside], odometry.poses[~inside], None, odometry.frame_id)

    return fault


def jumps(delta: tuple[float, float, float], count: int) -> Fault:
    """So many motions (m, m, rad) that were none, from three to nine tenths of the time."""

    def fault(odometry: Trajectory) -> Trajectory:
        first, last = odometry.span_ns
        poses = odometry.poses.copy()
        for share in _BEGIN + 0.6 * np.arange(count) / count:
            at = int(np.searchsorted(odometry.stamp_ns, first + share * (last - first)))
            there = se2.compose(poses[at - 1], np.array(delta))
            poses[at:] = se2.compose(there, se2.between(poses[at], poses[at:]))
        return Trajectory(odometry.stamp_ns, poses, None, odometry.frame_id)

    return fault


def lost(seconds: float, *, is_told: bool) -> Fault:
    """Nothing of the motion for a while: without samples, or with the last pose told over and over again."""

    def fault(odometry: Trajectory) -> Trajectory:
        inside = np.flatnonzero(_during(odometry, seconds))
        poses, after = odometry.poses.copy(), inside[-1] + 1
        last = poses[inside[0] - 1]
        poses[after:] = se2.compose(last, se2.between(poses[after - 1], poses[after:]))
        poses[inside] = last
        kept = np.ones(len(odometry), dtype=bool)
        kept[inside] = is_told
        return Trajectory(odometry.stamp_ns[kept], poses[kept], None, odometry.frame_id)

    return fault


FAULTS: dict[str, Fault] = {
    "none": lambda odometry: odometry,
    "no odometry for 10 s": without(10.0),
    "no odometry for 32 s": without(32.0),
    "lost for 20 s, no odometry": lost(20.0, is_told=False),
    "lost for 20 s, the last pose repeated": lost(20.0, is_told=True),
    "a jump of 300 m": jumps(_LARGE_JUMP, 1),
    "three jumps of 6 m": jumps(_SMALL_JUMP, 3),
}


class FaultyOdometry:
    """A drive whose odometry has a fault, as one `sequences.sequence.Sequence`."""

    def __init__(self, sequence: Sequence, fault: Fault) -> None:
        self._sequence, self._fault = sequence, fault

    @property
    def name(self) -> str:
        """The drive's, as all else."""
        return self._sequence.name

    @property
    def map(self) -> MapRaster:
        """The map."""
        return self._sequence.map

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """The scans'."""
        return self._sequence.stamps_ns

    @property
    def ground_z(self) -> float:
        """Of the scans."""
        return self._sequence.ground_z

    @property
    def scans_simulated(self) -> bool:
        """Whether they are."""
        return self._sequence.scans_simulated

    @property
    def ground_truth(self) -> Trajectory | None:
        """The truth."""
        return self._sequence.ground_truth

    @property
    def odometry_names(self) -> tuple[str, ...]:
        """What there is."""
        return self._sequence.odometry_names

    def scan(self, index: int) -> NDArray[np.float32]:
        """A scan."""
        return self._sequence.scan(index)

    def odometry(self, name: str) -> Trajectory:
        """The faulty one."""
        return self._fault(self._sequence.odometry(name))


def main(
    sequence: Annotated[Path, typer.Option(help="Drive with ground truth.", metavar="PATH")],
    odometry: Annotated[str | None, typer.Option(help="Default: the first that is not emulated.")] = None,
    seeds: Annotated[str, typer.Option(help="Seeds of the starts and particles.", metavar="N,N,...")] = "0,1,2",
) -> None:
    """Print a table: errors and consistency by fault, mean and standard deviation over the seeds."""
    drive, matcher = open_sequence(sequence), load_matcher("rotmatch")
    if drive.ground_truth is None:
        raise SkyfixError(f"{drive.name}: expected ground truth to compare with, found none")
    name = odometry or default_odometry(drive)
    found: dict[str, list[Mapping[str, Any]]] = {fault: [] for fault in FAULTS}
    for seed in progress(seed_numbers(seeds), description="seeds"):
        settings = TrackSettings(name, seed=seed, snapshots=0)
        for label, fault in FAULTS.items():
            found[label].append(track(FaultyOdometry(drive, fault), matcher, settings).metrics)
    scans = "simulated" if drive.scans_simulated else "real"
    emulated = " (emulated)" if odometry_is_emulated(name) else ""
    typer.echo(f"{drive.name}, {scans} scans, {matcher.name}, odometry {name}{emulated}, seeds {seeds}\n")
    rows = [_row(label, method, found[label]) for label in FAULTS for method in _METHODS]
    typer.echo(markdown_table(["odometry's fault", "method", *_COLUMNS, "doubted"], rows, left=2), nl=False)


def _row(fault: str, method: str, metrics: list[Mapping[str, Any]]) -> list[str]:
    spread = over_seeds([each[method] for each in metrics])
    doubted = sum(bool(each["trust"]["doubts"]) for each in metrics) if method in ("filter", "smoother") else None
    told = "-" if doubted is None else f"{doubted} of {len(metrics)}"
    return [fault, _METHODS[method], *(cell(spread.get(key), unit) for key, unit in _COLUMNS.values()), told]


def _during(odometry: Trajectory, seconds: float) -> NDArray[np.bool_]:
    first, last = odometry.span_ns
    begin = first + _BEGIN * (last - first)
    inside: NDArray[np.bool_] = (odometry.stamp_ns > begin) & (odometry.stamp_ns < begin + 1e9 * seconds)
    if not inside.any() or inside[-1]:
        raise SkyfixError(f"odometry: expected {seconds:g} s and more after three tenths of it, got less")
    return inside


if __name__ == "__main__":
    run(main, "odometry_faults")
