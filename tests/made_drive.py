"""A made-up drive in the folder format, and an emulated matcher that knows the truth, for tests around matching.

A scan of this drive holds no scenery: its reflectance says which frame it is, and the emulated matcher answers with a
Gaussian likelihood about that frame's true pose, off by a seeded error. Nothing here says how well scans match maps.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fusion import se2
from fusion.likelihood import LikelihoodVolume
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from sequences.trajectory_io import format_seconds, write_tum

FRAMES = 30
STEP_M = 2.0
GROUND_Z = -1.7
YAW_BINS = 120


@dataclass(frozen=True)
class MadeDrive:
    """A folder on disk and what is in it."""

    path: Path
    truth: Trajectory
    odometry: Trajectory

    def scan_file(self, index: int) -> Path:
        """The file of one scan."""
        return self.path / "scans" / f"{index:06d}.bin"


@dataclass
class EmulatedMatcher:
    """Knows the truth: implements the matchers' protocol with Gaussian likelihoods about it.

    At the frames in `mistakes` it errs by as much, (x, y, yaw) on the axes of the map, and is as sure as ever.
    """

    truth: NDArray[np.float64]
    sigma_m: float = 0.5
    sigma_rad: float = float(np.deg2rad(2.0))
    name: str = "emulated"
    error_correlation_length_m: float = 0.0
    mistakes: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    searches: list[SearchRegion] = field(default_factory=list)

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        self.searches.append(search)
        index = round(float(points[0, 3]) * 1000)
        noise = np.random.default_rng([7, index]).normal(size=3) * [self.sigma_m, self.sigma_m, self.sigma_rad]
        centre = self.truth[index] + noise + self.mistakes.get(index, np.zeros(3))
        grid = map_raster.grid.window(search.centre[:2], search.half_extent_m)
        x, y = grid.centres()
        yaw = np.arange(YAW_BINS) * 2.0 * np.pi / YAW_BINS
        squared = (
            ((x[None, :, None] - centre[0]) / self.sigma_m) ** 2
            + ((y[:, None, None] - centre[1]) / self.sigma_m) ** 2
            + (se2.wrap(yaw - centre[2]) / self.sigma_rad) ** 2
        )
        return LikelihoodVolume.from_scores(-0.5 * squared, grid)


def write_made_drive(path: Path, frames: int = FRAMES, map_half_extent_m: float = 60.0) -> MadeDrive:
    """Write a left-hand bend of some 60 m with odometry that is 3 % long and turns by 0.2 degrees a frame."""
    (path / "scans").mkdir(parents=True)
    (path / "odometry").mkdir()
    step = np.array([STEP_M, 0.0, np.deg2rad(1.5)])
    truth = _chain(np.array([-20.0, -15.0, 0.3]), np.repeat(step[None], frames - 1, axis=0))
    drifting = step * [1.03, 1.0, 1.0] + [0.0, 0.0, np.deg2rad(0.2)]
    odometry = _chain(np.zeros(3), np.repeat(drifting[None], frames - 1, axis=0))
    stamps = 1_700_000_000_000_000_001 + np.arange(frames, dtype=np.int64) * 200_000_000
    made = MadeDrive(path, Trajectory(stamps, truth), Trajectory(stamps, odometry, None, "wheels"))
    write_map(path, map_half_extent_m)
    write_tum(path / "ground_truth.tum", made.truth)
    write_tum(path / "odometry" / "wheels.tum", made.odometry)
    (path / "sensor.json").write_text(json.dumps({"ground_z": GROUND_Z}))
    (path / "scans" / "times.txt").write_text("".join(f"{format_seconds(int(stamp))}\n" for stamp in stamps))
    for index in range(frames):
        made_scan(index).tofile(made.scan_file(index))
    return made


def made_scan(index: int, n: int = 200) -> NDArray[np.float32]:
    """Points (n, 4) float32 whose reflectance says which frame they are of."""
    points = np.random.default_rng(index).uniform(-20.0, 20.0, size=(n, 4)).astype(np.float32)
    points[:, 2] = np.abs(points[:, 2]) / 10.0 + GROUND_Z
    points[:, 3] = index / 1000.0
    return points


def write_map(path: Path, half_extent_m: float) -> None:
    """Write a map of grass with a few houses about the origin."""
    side = round(2 * half_extent_m / 0.5)
    indices = np.zeros((side, side), dtype=np.uint8)
    for row in range(10, side - 30, 50):
        indices[row : row + 20, 12:40] = 1
    Image.fromarray(indices).save(path / "semantic.png")
    layers = [{"name": "semantic", "file": "semantic.png", "classes": ["grass", "building"]}]
    size = {"metres_per_pixel": 0.5, "rows": side, "cols": side, "x0": -half_extent_m, "y0": -half_extent_m}
    (path / "map.json").write_text(json.dumps({**size, "layers": layers, "origin_lat_lon_alt": None}))


def _chain(start: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    poses = [start]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)
