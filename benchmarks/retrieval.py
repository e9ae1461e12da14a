"""Is the right tile among the first? Scans looked up in an index of 2 x 2 km, put together of maps far apart.

    python -m benchmarks.retrieval drives/kitti360_0009 demo drives/kitti00_osm --scans 120

The map is three windows side by side: 1 x 2 km about the first drive on the left, 1 x 1 km about each of the others on
the right. Scans are simulated along the drives, as many on each, in a world that is not the map (see
`sequences.world_raster`; the demo has its own), whatever scans the drives have, and each is looked up by itself. The
row 'prior' is tiles taken at random.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.command import run
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from learned.retrieval import Retriever
from learned.rotmatch import RotMatch
from sequences.demo import DemoSequence
from sequences.lidar import LidarModel, simulate_scan
from sequences.registry import OpenOptions, open_sequence
from sequences.retrieval import look_up, summary_of, summary_table
from sequences.sequence import Sequence, checked_points
from sequences.world import World, world_from_raster

_PIXEL_M, _SIDE_M = 0.5, 2000.0
_PLACES_M = (
    ((1000.0, 2000.0), (0.0, 0.0)),
    ((1000.0, 1000.0), (1000.0, 0.0)),
    ((1000.0, 1000.0), (1000.0, 1000.0)),
)
"""Width and height of each window, and where its lower left corner is put."""
_EDGE_M = 80.0
"""Scans are taken so far from a window's edge: what they see is on the map."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A part of the map: what a drive's map shows about it.

    Attributes
    ----------
    drive, map
        Whose it is, and what is shown, in the drive's frame.
    poses
        (N, 3) of the drive's scans that lie in it, away from its edge; in the drive's frame.
    shift
        (3,) what has to be added to them to have them in the whole map's frame.
    """

    drive: Sequence
    map: MapRaster
    poses: FloatArray
    shift: FloatArray

    @classmethod
    def about(cls, drive: Sequence, size_m: tuple[float, float], corner_m: tuple[float, float]) -> Window:
        """The window of a size (width, height) about the middle of a drive, its lower left corner put at a place.

        Raises
        ------
        SkyfixError
            If the drive has no truth or none in the window, or a map without classes.
        """
        if drive.ground_truth is None or drive.map.classes is None:
            raise SkyfixError(f"{drive.name}: expected a drive with ground truth on a map with classes")
        first, last = drive.ground_truth.span_ns
        stamps = drive.stamps_ns[(drive.stamps_ns >= first) & (drive.stamps_ns <= last)]
        poses = drive.ground_truth.interpolate(stamps)
        corner = 0.5 * (poses[:, :2].min(axis=0) + poses[:, :2].max(axis=0)) - 0.5 * np.array(size_m)
        whole = drive.map.grid
        low = [whole.x0, whole.y0] + np.rint((corner - [whole.x0, whole.y0]) / _PIXEL_M) * _PIXEL_M
        cols, rows = (round(side / _PIXEL_M) for side in size_m)
        within = drive.map.resampled(MapGrid(rows, cols, _PIXEL_M, *low.tolist()))
        inside = np.minimum(poses[:, :2] - low, low + size_m - poses[:, :2]).min(axis=1) >= _EDGE_M
        if not inside.any():
            raise SkyfixError(f"{drive.name}: expected a drive inside a window of {size_m} m, got none of it there")
        return cls(drive, within, poses[inside], np.array([*(corner_m - low), 0.0]))

    def world(self, seed: int) -> World:
        """What scans are simulated in, in the drive's frame."""
        return self.drive.world if isinstance(self.drive, DemoSequence) else world_from_raster(self.map, seed)


class Mosaic:
    """Scans simulated in several windows of one map, as a `sequences.sequence.Sequence` without odometry.

    Parameters
    ----------
    windows
        Parts of the map.
    scans
        So many in all, spread evenly over the windows and along their drives.
    seed
        Of worlds and scans.
    """

    scans_simulated = True
    odometry_names: tuple[str, ...] = ()

    def __init__(self, windows: list[Window], scans: int, seed: int) -> None:
        self.name = " + ".join(window.drive.name for window in windows)
        self._seed, self._lidar = seed, LidarModel()
        self._worlds = [window.world(seed) for window in windows]
        self._taken: list[tuple[int, FloatArray]] = []
        for number, window in enumerate(windows):
            share = scans // len(windows) + (number < scans % len(windows))
            at = np.linspace(0, len(window.poses) - 1, share).round().astype(int)
            self._taken += [(number, pose) for pose in window.poses[at]]
        self.ground_z = -self._lidar.mount_height_m
        self.map = _side_by_side(windows)
        self.stamps_ns: NDArray[np.int64] = np.arange(len(self._taken), dtype=np.int64) * 10**9
        poses = np.array([pose + windows[number].shift for number, pose in self._taken])
        self.ground_truth: Trajectory | None = Trajectory(self.stamps_ns, poses, None, "map")

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) of a scan; the same at every call."""
        number, pose = self._taken[index]
        points = simulate_scan(self._worlds[number], pose, self._lidar, np.random.default_rng((self._seed, index)))
        return checked_points(points, f"scan {index}")

    def odometry(self, name: str) -> Trajectory:
        """There is none."""
        raise SkyfixError(f"odometry: expected none, got {name}")


def _side_by_side(windows: list[Window]) -> MapRaster:
    side = round(_SIDE_M / _PIXEL_M)
    classes = np.zeros((side, side), np.uint8)
    for window in windows:
        grid = window.map.grid
        left, below = (round(at / _PIXEL_M) for at in ([grid.x0, grid.y0] + window.shift[:2]).tolist())
        assert window.map.classes is not None  # `about` saw to it
        classes[side - below - grid.rows : side - below, left : left + grid.cols] = window.map.classes
    return MapRaster.from_classes(MapGrid(side, side, _PIXEL_M, 0.0, 0.0), classes)


def main(
    drives: Annotated[list[str], typer.Argument(help="Three drives: the first gets half of the map.", metavar="DRIVE")],
    scans: Annotated[int, typer.Option(help="Simulated scans in all.", metavar="N")] = 120,
    seed: Annotated[int, typer.Option(help="Of worlds and scans.")] = 0,
) -> None:
    """Look the scans up and print how often the right tile is among the first."""
    if len(drives) != len(_PLACES_M) or scans < len(_PLACES_M):
        raise SkyfixError(f"retrieval: expected 3 drives and 3 scans or more, got {len(drives)} and {scans}")
    opened = [open_sequence(Path(drive), OpenOptions(seed)) for drive in drives]
    windows = [Window.about(drive, *place) for drive, place in zip(opened, _PLACES_M, strict=True)]
    mosaic, retriever = Mosaic(windows, scans, seed), Retriever(RotMatch.shipped())
    index = retriever.build(mosaic.map)
    typer.echo(summary_table(summary_of(mosaic, index, look_up(mosaic, retriever, index, scans))), nl=False)


if __name__ == "__main__":
    run(main, "retrieval")
