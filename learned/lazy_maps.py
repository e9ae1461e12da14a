"""A factored likelihood whose headings are computed where they are asked for.

An orientation head that is linear in a cell's features needs 94 MB to write out for 256 x 256 cells and 360 bins; a
filter looks at a few hundred cells of them. This keeps features and head, and is otherwise what
`fusion.location_orientation.LocationOrientationMaps` is: the joint density is that of the position times that of the
heading there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray, checked
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.interpolation import corners
from fusion.likelihood import DEFAULT_FLOOR, LikelihoodVolume, OutlierMixture, checked_temperature
from fusion.location_orientation import LocationOrientationMaps
from learned.matcher import SearchRegion

_CELLS_AT_ONCE = 4096


@dataclass(frozen=True, slots=True, eq=False)
class LazyPoseMaps:
    """``p(x, y) * p(yaw | x, y)`` with the second factor a softmax of ``weight @ features + bias``.

    Implements `fusion.likelihood.PoseLikelihood`.

    Parameters
    ----------
    location : (rows, cols) float32
        ln density per m^2, ``sum(exp(location)) * pixel_area == 1``.
    features : (rows, cols, C) float32
        What the head is applied to.
    weight, bias : (K, C), (K,) float32
        The head; bin k is the heading 2 pi k / K in the map frame.
    grid : MapGrid
        Where the cells lie.
    confidence : float
        The network's own probability that its best pose is right; carried along, not applied.

    Raises
    ------
    SkyfixError
        When shapes disagree or a value is not finite.
    """

    location: Float32Array
    features: Float32Array
    weight: Float32Array
    bias: Float32Array
    grid: MapGrid
    confidence: float = 1.0

    def __post_init__(self) -> None:
        plan = (self.grid.rows, self.grid.cols)
        if self.location.shape != plan or self.features.shape[:2] != plan or self.features.ndim != 3:
            raise SkyfixError(
                f"pose maps: expected {plan} and {(*plan, 'C')}, got {self.location.shape} and {self.features.shape}"
            )
        if self.weight.shape != (len(self.bias), self.features.shape[2]):
            expected = (len(self.bias), self.features.shape[2])
            raise SkyfixError(f"orientation head: expected {expected}, got {self.weight.shape}")
        if not all(np.isfinite(a).all() for a in (self.location, self.features, self.weight, self.bias)):
            raise SkyfixError("pose maps: expected finite values, got NaN or an infinity")

    @property
    def yaw_bins(self) -> int:
        """K."""
        return len(self.bias)

    def orientation(self, pixels: IntArray) -> Float32Array:
        """ln density per rad (N, K) of the headings at pixels (N,), indices into the flattened rows of the grid."""
        logits = self.features.reshape(-1, self.features.shape[2])[pixels] @ self.weight.T + self.bias
        peak = logits.max(axis=1, keepdims=True)
        total = np.log(np.exp(logits - peak).sum(axis=1, keepdims=True)) + peak
        return logits - total - np.float32(math.log(se2.TWO_PI / self.yaw_bins))

    def within(self, search: SearchRegion) -> LazyPoseMaps:
        """Only the cells that a search region touches, the position given to be in one of them.

        Raises
        ------
        SkyfixError
            When it touches none.
        """
        grid = search_window(self.grid, search)
        top, left = self.grid.offset_of(grid)
        bottom, right = top + grid.rows, left + grid.cols
        location = self.location[top:bottom, left:right].astype(np.float64)
        location = location - logsumexp(location) - 2.0 * math.log(grid.metres_per_pixel)
        features = self.features[top:bottom, left:right]
        return replace(self, location=location.astype(np.float32), features=features, grid=grid)

    def to_maps(self) -> LocationOrientationMaps:
        """Everything written out."""
        headings = self.orientation(np.arange(self.location.size))
        orientation = np.ascontiguousarray(headings.T).reshape(self.yaw_bins, *self.location.shape)
        return LocationOrientationMaps(self.location, orientation, self.grid, self.confidence)

    def to_volume(self, bins: list[int], uniform_floor: float = 0.0) -> LikelihoodVolume:
        """The joint density over some heading bins, given that the heading is in one of them.

        Parameters
        ----------
        bins
            Headings that are searched; the others count as not evaluated.
        uniform_floor
            Weight of the uniform density, over the grid and all headings, that is mixed in before.
        """
        joint = np.empty((self.location.size, len(bins)), dtype=np.float32)
        for start in range(0, self.location.size, _CELLS_AT_ONCE):
            pixels = np.arange(start, min(start + _CELLS_AT_ONCE, self.location.size))
            joint[pixels] = self.location.reshape(-1)[pixels, None] + self.orientation(pixels)[:, bins]
        if uniform_floor > 0.0:
            uniform = math.log(uniform_floor) - math.log(self.grid.area_m2 * se2.TWO_PI)
            joint = np.logaddexp(joint + np.float32(math.log1p(-uniform_floor)), np.float32(uniform))
        scores = np.zeros((*self.location.shape, self.yaw_bins), dtype=np.float32)
        scores[:, :, bins] = joint.reshape(*self.location.shape, len(bins))
        valid = np.zeros(self.yaw_bins, dtype=np.bool_)
        valid[bins] = True
        return LikelihoodVolume.from_scores(scores, self.grid, valid=valid)

    @property
    def searched_volume(self) -> float:
        """The crop times all headings, m^2 rad."""
        return self.grid.area_m2 * se2.TWO_PI

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """Trilinear interpolation of the joint log density at poses (N, 3); the head is applied around them alone."""
        poses = checked("poses", poses, ("N", 3))
        around = list(corners(self.grid, self.yaw_bins, poses))
        pixels, place = np.unique(np.stack([pixel for _, pixel, _ in around]), return_inverse=True)
        place = place.reshape(len(around), len(poses))
        result = np.zeros(len(poses))
        for start in range(0, len(pixels), _CELLS_AT_ONCE):
            block = pixels[start : start + _CELLS_AT_ONCE]
            joint = self.location.reshape(-1)[block, None] + self.orientation(block)
            for (cell, pixel, weight), index in zip(around, place, strict=True):
                here = np.flatnonzero((index >= start) & (index < start + len(block)))
                value = joint[index[here] - start, cell[here] - pixel[here] * self.yaw_bins]
                result[here] += weight[here] * np.maximum(value, DEFAULT_FLOOR)
        return np.where(self.grid.contains(poses[:, :2]), result, DEFAULT_FLOOR)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw cells by their mass, a heading bin in each, then uniformly inside both; (n, 3)."""
        log_p = self.location.reshape(-1).astype(np.float64)
        pixel = rng.choice(self.location.size, size=n, p=np.exp(log_p - logsumexp(log_p)))
        distinct, place = np.unique(pixel, return_inverse=True)
        drawn, yaw_bin = rng.random(n), np.zeros(n, dtype=np.int64)
        for start in range(0, len(distinct), _CELLS_AT_ONCE):
            block = distinct[start : start + _CELLS_AT_ONCE]
            here = np.flatnonzero((place >= start) & (place < start + len(block)))
            cumulative = np.cumsum(np.exp(self.orientation(block), dtype=np.float64), axis=1)
            cumulative /= cumulative[:, -1:]
            below = (cumulative[place[here] - start] < drawn[here, None]).sum(axis=1)
            yaw_bin[here] = np.minimum(below, self.yaw_bins - 1)
        jitter = rng.random((n, 3))
        row, col = np.divmod(pixel, self.grid.cols)
        xy = self.grid.xy_from_pixel(np.stack([row, col], axis=-1) + jitter[:, :2])
        return np.column_stack([xy, se2.wrap((yaw_bin + jitter[:, 2] - 0.5) * se2.TWO_PI / self.yaw_bins)])

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """The log density (N,) of the cell that each pose (N, 3) lies in; the floor outside the crop."""
        poses = checked("poses", poses, ("N", 3))
        centres = self.grid.xy_from_pixel(np.floor(self.grid.pixel_from_xy(poses[:, :2])) + 0.5)
        step = se2.TWO_PI / self.yaw_bins
        of_cells = self.log_density(np.column_stack([centres, np.rint(poses[:, 2] / step) * step]))
        return np.where(self.grid.contains(poses[:, :2]), of_cells, DEFAULT_FLOOR)

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest modes of the joint density, for which everything is written out."""
        return self.to_volume(list(range(self.yaw_bins))).modes(k)

    def tempered(self, temperature: float) -> LazyPoseMaps:
        """The joint density to the power 1 / temperature: the head is divided, its normaliser moves to the location."""
        if checked_temperature(temperature) == 1.0:
            return self
        shift = np.zeros(self.location.size)
        step = math.log(se2.TWO_PI / self.yaw_bins)
        for start in range(0, self.location.size, _CELLS_AT_ONCE):
            pixels = np.arange(start, min(start + _CELLS_AT_ONCE, self.location.size))
            shift[pixels] = logsumexp(self.orientation(pixels).astype(np.float64) / temperature, axis=1) + step
        location = self.location.astype(np.float64) / temperature + shift.reshape(self.location.shape)
        location = location - logsumexp(location) - 2.0 * math.log(self.grid.metres_per_pixel)
        weight, bias = (parameter / np.float32(temperature) for parameter in (self.weight, self.bias))
        return replace(self, location=location.astype(np.float32), weight=weight, bias=bias)

    def with_heading_concentration(self, concentration: float) -> LazyPoseMaps:
        """The density of the heading at each position to a power, normalised again: the head is multiplied by it.

        See `learned.calibration.with_heading_concentration`; the density of the position stays as it is.
        """
        weight, bias = (parameter * np.float32(concentration) for parameter in (self.weight, self.bias))
        return replace(self, weight=weight, bias=bias)

    def with_outliers(self, probability: float) -> OutlierMixture:
        """Mix in the uniform density over the grid."""
        return OutlierMixture(self, probability)


def search_window(grid: MapGrid, search: SearchRegion) -> MapGrid:
    """The part of a grid, on its cells, that a search region touches.

    Raises
    ------
    SkyfixError
        When it touches none.
    """
    half = search.half_extent_m
    shape = (grid.rows, grid.cols)
    low = np.floor(grid.pixel_from_xy(search.centre[:2] + [-half, half]) + 1e-6)
    high = np.ceil(grid.pixel_from_xy(search.centre[:2] + [half, -half]) - 1e-6)
    (top, left), (bottom, right) = (np.clip(edge.astype(np.int64), 0, shape) for edge in (low, high))
    if bottom <= top or right <= left:
        raise SkyfixError(f"search region: expected some of {grid}, got {search}")
    x0, y0 = grid.xy_from_pixel((bottom, left))
    return MapGrid(int(bottom - top), int(right - left), grid.metres_per_pixel, float(x0), float(y0))
