"""What all filters of the benchmark share: the volume, the clouds, the motion and the measurement model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.ndimage import map_coordinates

from fusion import LikelihoodVolume, MapGrid, OdometryIncrement, se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.likelihood import log_uniform_density

SEED = 0
INCREMENT = OdometryIncrement(1, np.array([1.0, 0.0, 0.02]), np.diag([0.05, 0.03, 0.01]) ** 2)
NOISE_ROOT = np.diag([0.05, 0.03, 0.01])
OUTLIERS = 0.05

Estimated = tuple[FloatArray, FloatArray]


class Lookup(Protocol):
    """ln density (N,) of a volume at poses (N, 3)."""

    @property
    def volume(self) -> LikelihoodVolume:
        """What is looked up."""
        ...

    def __call__(self, poses: FloatArray) -> FloatArray:
        """Trilinear between the cells, the floor outside the crop."""
        ...


def example_volume(cells: int = 96, bins: int = 360) -> LikelihoodVolume:
    """Two peaks of 1 m and 3 degrees, one of them twice as high, over clutter; cells of half a metre."""
    grid = MapGrid(cells, cells, 0.5, -0.25 * cells, -0.25 * cells)
    x, y = grid.centres()
    yaw = se2.TWO_PI * np.arange(bins) / bins

    def peak(x0: float, y0: float, yaw0: float) -> FloatArray:
        squared = (x[None, :, None] - x0) ** 2 + (y[:, None, None] - y0) ** 2
        return -0.5 * squared + (np.cos(yaw - yaw0) - 1.0) / np.deg2rad(3.0) ** 2

    quarter = 0.125 * cells
    scores = np.logaddexp(peak(0.0, 0.0, 0.1), peak(quarter, -quarter, 0.1 + np.pi) - np.log(2.0))
    return LikelihoodVolume.from_scores(np.logaddexp(scores, -12.0), grid)


def cloud(volume: LikelihoodVolume, count: int, spread: bool) -> FloatArray:
    """Particles (count, 3): all over the crop, or around the higher peak as in tracking."""
    rng = np.random.default_rng(SEED)
    if spread:
        half = np.array([0.5 * volume.grid.width_m, 0.5 * volume.grid.height_m, np.pi])
        return rng.uniform(-half, half, (count, 3))
    return np.array([-1.0, 0.0, 0.08]) + rng.standard_normal((count, 3)) * [1.0, 1.0, 0.05]


@dataclass(frozen=True, slots=True, eq=False)
class ScipyLookup:
    """Trilinear lookup in a volume by map_coordinates, its headings padded once so that they wrap."""

    padded: Float32Array
    volume: LikelihoodVolume

    @classmethod
    def of(cls, volume: LikelihoodVolume) -> ScipyLookup:
        """Pad the volume by its first heading."""
        return cls(np.concatenate([volume.log_prob, volume.log_prob[:, :, :1]], axis=2), volume)

    def __call__(self, poses: FloatArray) -> FloatArray:
        """ln density (N,) at poses (N, 3); the floor outside the crop."""
        grid = self.volume.grid
        row, col = (grid.pixel_from_xy(poses[:, :2]) - 0.5).T
        turns = poses[:, 2] / se2.TWO_PI
        heading = (turns - np.floor(turns)) * (self.padded.shape[2] - 1)
        values = map_coordinates(self.padded, [row, col, heading], output=np.float64, order=1, mode="nearest")
        return np.where(grid.contains(poses[:, :2]), values, self.volume.floor)


@dataclass(frozen=True, slots=True, eq=False)
class NumpyLookup:
    """The same by numpy alone, in float32 where that helps: the fastest that we could write."""

    flat: Float32Array
    volume: LikelihoodVolume

    @classmethod
    def of(cls, volume: LikelihoodVolume) -> NumpyLookup:
        """Pad the volume by its first heading, so that the upper neighbour is the next number."""
        return cls(np.concatenate([volume.log_prob, volume.log_prob[:, :, :1]], axis=2).reshape(-1), volume)

    def __call__(self, poses: FloatArray) -> FloatArray:
        """ln density (N,) at poses (N, 3); the floor outside the crop."""
        grid, bins = self.volume.grid, self.volume.log_prob.shape[2]
        col = (poses[:, 0] - grid.x0) * (1.0 / grid.metres_per_pixel) - 0.5
        row = (grid.rows - 0.5) - (poses[:, 1] - grid.y0) * (1.0 / grid.metres_per_pixel)
        inside = (np.abs(col - (0.5 * grid.cols - 0.5)) <= 0.5 * grid.cols) & (
            np.abs(row - (0.5 * grid.rows - 0.5)) <= 0.5 * grid.rows
        )
        col, row = np.clip(col, 0.0, grid.cols - 1.000001), np.clip(row, 0.0, grid.rows - 1.000001)
        heading = poses[:, 2] * (bins / se2.TWO_PI)
        heading += np.where(heading < 0.0, bins, 0.0)
        r, c, k = row.astype(np.int64), col.astype(np.int64), heading.astype(np.int64)
        k = np.minimum(k, bins - 1)
        fr, fc, fk = ((a - b).astype(np.float32) for a, b in ((row, r), (col, c), (heading, k)))
        at, east, south = (r * grid.cols + c) * (bins + 1) + k, bins + 1, grid.cols * (bins + 1)

        def between(index: IntArray) -> Float32Array:
            low = self.flat.take(index)
            return low + fk * (self.flat.take(index + 1) - low)

        north_west, south_west = between(at), between(at + south)
        north = north_west + fc * (between(at + east) - north_west)
        far = south_west + fc * (between(at + (south + east)) - south_west)
        return np.where(inside, np.maximum(north + fr * (far - north), self.volume.floor), self.volume.floor)


def mixture(lookup: Lookup, poses: FloatArray) -> FloatArray:
    """Density (N,), not its logarithm, with outliers."""
    uniform = np.exp(log_uniform_density(lookup.volume.grid))
    return (1.0 - OUTLIERS) * np.exp(lookup(poses)) + OUTLIERS * uniform


def moved(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Poses (N, 3) after the increment and its noise."""
    forward, left, turn = (INCREMENT.delta + rng.standard_normal(poses.shape) @ NOISE_ROOT.T).T
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    result = np.empty_like(poses)
    result[:, 0] = poses[:, 0] + cos * forward - sin * left
    result[:, 1] = poses[:, 1] + sin * forward + cos * left
    result[:, 2] = (poses[:, 2] + turn + np.pi) % se2.TWO_PI - np.pi
    return result


def moments(poses: FloatArray, weights: FloatArray) -> Estimated:
    """Mean (3,) and covariance (3, 3) of poses (N, 3) with weights (N,) that sum to 1."""
    mean = weights @ poses
    mean[2] = np.arctan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    residual = poses - mean
    residual[:, 2] = (residual[:, 2] + np.pi) % se2.TWO_PI - np.pi
    return mean, (weights[:, None] * residual).T @ residual
