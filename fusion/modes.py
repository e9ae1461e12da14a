"""From a likelihood on a grid to a few Gaussians: what a factor graph can use of it.

A mode is a local maximum that is the highest within a separation radius. Its weight, mean and covariance are the
moments of the probability mass around it: of the cells that are nearer to it than to another mode, within a window of
three standard deviations (found by growing the window until it holds). The moments are those of the histogram, the
spread inside a cell (width^2 / 12) included, which keeps every covariance positive definite.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import BoolArray, Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture

if TYPE_CHECKING:
    from fusion.likelihood import LikelihoodVolume

_RANGE_NATS = 12.0  # cells this far below the peak hold no mass worth counting
_WINDOW_SIGMAS = 3.0
_WINDOW_ROUNDS = 6


def circular_run(mask: BoolArray) -> IntArray:
    """Indices of the shortest circular run that covers every True of `mask` (K,), in running order."""
    size = len(mask)
    hits = np.flatnonzero(mask)
    gaps = np.diff(np.append(hits, hits[0] + size))
    last = int(np.argmax(gaps))
    start = int(hits[(last + 1) % len(hits)])
    return (start + np.arange(size - int(gaps[last]) + 1)) % size


@dataclass(frozen=True, slots=True)
class _Box:
    """The part of a volume that holds its mass: log densities, and where they lie in the volume."""

    log_prob: Float32Array  # (rows, cols, bins)
    row: int
    col: int
    bins: IntArray
    is_full_circle: bool

    @classmethod
    def above(cls, volume: "LikelihoodVolume", threshold: float) -> "_Box":
        bin_count = volume.log_prob.shape[2]
        bins = circular_run(volume.bin_peaks > threshold)
        is_full_circle = len(bins) == bin_count
        bins = np.arange(bin_count) if is_full_circle else bins
        values = volume.log_prob if is_full_circle else volume.log_prob.take(bins, axis=2)
        plan = values.max(axis=2) > threshold
        rows, cols = np.flatnonzero(plan.any(axis=1)), np.flatnonzero(plan.any(axis=0))
        box = values[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        return cls(box, int(rows[0]), int(cols[0]), bins, is_full_circle)

    def maxima(self, threshold: float) -> IntArray:
        """Cells (N, 3) above the threshold that no neighbour exceeds, highest first."""
        highest = self.log_prob
        for axis in range(3):
            edge: Literal["wrap", "edge"] = "wrap" if axis == 2 and self.is_full_circle else "edge"
            padded = np.pad(highest, [(int(axis == i), int(axis == i)) for i in range(3)], mode=edge)
            low, mid, high = (np.moveaxis(padded, axis, 0)[i : i + highest.shape[axis]] for i in range(3))
            highest = np.moveaxis(np.maximum(np.maximum(low, mid), high), 0, axis)
        cells = np.argwhere((self.log_prob == highest) & (self.log_prob > threshold))
        return cells[np.argsort(-self.log_prob[tuple(cells.T)], kind="stable")]


def _offsets(cells: IntArray, origin: IntArray, bin_count: int) -> IntArray:
    """Cell indices (..., 3) counted from `origin`, the third the short way round the circle."""
    offset = cells - origin
    offset[..., 2] = (offset[..., 2] + bin_count // 2) % bin_count - bin_count // 2
    return offset


def _separate(cells: IntArray, k: int, reach: FloatArray, bin_count: int) -> IntArray:
    """Greedy non-maximum suppression: the first `k` of the cells, best first, more than `reach` (3,) cells apart."""
    kept: list[IntArray] = []
    while len(cells) and len(kept) < k:
        kept.append(cells[0])
        offset = (_offsets(cells, cells[0], bin_count) / reach) ** 2
        cells = cells[(offset[:, 0] + offset[:, 1] > 1.0) | (offset[:, 2] > 1.0)]
    return np.array(kept)


def _nearest_peak(shape: tuple[int, ...], peaks: IntArray, reach: FloatArray, bin_count: int) -> NDArray[np.int32]:
    """Index of the nearest peak for every cell of a box; position or heading, whichever is farther, counts."""
    nearest = np.zeros(shape, dtype=np.int32)
    least = np.full(shape, np.inf, dtype=np.float32)
    row, col, yaw = (np.arange(size) for size in shape)
    for index, peak in enumerate(peaks):
        around = (yaw - peak[2] + bin_count // 2) % bin_count - bin_count // 2
        position = ((row - peak[0]) / reach[0])[:, None] ** 2 + ((col - peak[1]) / reach[1]) ** 2
        heading = (around / reach[2]) ** 2
        distance = np.maximum(position.astype(np.float32)[:, :, None], heading.astype(np.float32))
        closer = distance < least
        nearest[closer] = index
        np.minimum(least, distance, out=least)
    return nearest


def _moments(
    mass: Float32Array, peak: IntArray, reach: FloatArray, wraps: bool
) -> tuple[float, FloatArray, FloatArray]:
    """Weight, mean offset from the peak and covariance, in cells, of the mass (rows, cols, bins) around a peak.

    The window starts at `reach` and grows to three standard deviations. Three sums over single axes give every
    moment: each pair of coordinates is seen in one of the three planes.
    """
    centre, half = np.zeros(3), reach.copy()
    for _ in range(_WINDOW_ROUNDS):
        first = np.ceil(centre - half).astype(np.int64)
        last = np.floor(centre + half).astype(np.int64)
        if wraps:
            last[2] = min(last[2], first[2] + mass.shape[2] - 1)
            first[:2] = np.maximum(first[:2], -peak[:2])
            last[:2] = np.minimum(last[:2], np.array(mass.shape[:2]) - 1 - peak[:2])
        else:
            first, last = np.maximum(first, -peak), np.minimum(last, np.array(mass.shape) - 1 - peak)
        row, col, yaw = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
        window = mass[peak[0] + row[0] : peak[0] + row[-1] + 1, peak[1] + col[0] : peak[1] + col[-1] + 1]
        window = window[:, :, (peak[2] + yaw) % mass.shape[2]]
        row_col, row_yaw, col_yaw = (window.sum(axis=axis).astype(np.float64) for axis in (2, 1, 0))
        weight = row_col.sum()
        by_row, by_col, by_yaw = row_col.sum(axis=1), row_col.sum(axis=0), row_yaw.sum(axis=0)
        centre = np.array([by_row @ row, by_col @ col, by_yaw @ yaw]) / weight
        row, col, yaw = row - centre[0], col - centre[1], yaw - centre[2]
        rc, rt, ct = row @ row_col @ col, row @ row_yaw @ yaw, col @ col_yaw @ yaw
        raw = [[by_row @ row**2, rc, rt], [rc, by_col @ col**2, ct], [rt, ct, by_yaw @ yaw**2]]
        covariance = np.array(raw) / weight + np.eye(3) / 12.0
        grown = np.maximum(reach, _WINDOW_SIGMAS * np.sqrt(np.diag(covariance)))
        if (grown <= 1.02 * half).all():
            break
        half = grown
    return float(weight), centre, covariance


def find_modes(
    volume: "LikelihoodVolume", k: int, separation_m: float = 3.0, separation_rad: float = np.deg2rad(10.0)
) -> GaussianMixture:
    """The `k` highest modes of a likelihood, as Gaussians; fewer when there are fewer.

    Parameters
    ----------
    volume : LikelihoodVolume
        Tempered beforehand when its errors are correlated in time.
    k : int
        Most modes to return, at least 1.
    separation_m, separation_rad : float
        Two modes differ by more than this in position or in heading.

    Returns
    -------
    GaussianMixture
        Sorted by falling weight; the weights are shares of the whole likelihood's mass.

    Raises
    ------
    SkyfixError
        When `k` or a separation is not positive.
    """
    if k < 1 or not (separation_m > 0.0 and separation_rad > 0.0):
        raise SkyfixError(f"modes: expected k, separations > 0, got {k}, {separation_m} m, {separation_rad} rad")
    grid, bin_count = volume.grid, volume.log_prob.shape[2]
    cell = np.array([grid.metres_per_pixel, grid.metres_per_pixel, se2.TWO_PI / bin_count])
    reach = np.maximum(np.array([separation_m, separation_m, separation_rad]) / cell, 1.0)
    threshold = max(float(volume.bin_peaks.max()) - _RANGE_NATS, volume.floor)
    box = _Box.above(volume, threshold)
    peaks = _separate(box.maxima(threshold), k, reach, bin_count)
    mass = np.exp(box.log_prob) * np.float32(volume.cell_volume)
    nearest = _nearest_peak(mass.shape, peaks, reach, bin_count)

    cell_axes = np.array([[0.0, cell[0], 0.0], [-cell[1], 0.0, 0.0], [0.0, 0.0, cell[2]]])  # [x, y, yaw] per cell
    weights, means, covariances = [], [], []
    for index, peak in enumerate(peaks):
        weight, offset, covariance = _moments(np.where(nearest == index, mass, 0), peak, reach, box.is_full_circle)
        row_col = np.array([box.row, box.col]) + peak[:2] + 0.5
        at_peak = np.append(grid.xy_from_pixel(row_col), box.bins[peak[2]] * cell[2])
        weights.append(weight)
        means.append(at_peak + cell_axes @ offset)
        covariances.append(cell_axes @ covariance @ cell_axes.T)
    ranked = np.argsort(weights)[::-1]
    share = np.array(weights) / max(1.0, sum(weights))  # the sum may exceed 1 by rounding
    return GaussianMixture(share[ranked], np.array(means)[ranked], np.array(covariances)[ranked])
