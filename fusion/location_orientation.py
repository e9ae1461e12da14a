"""A factored likelihood: a density of position, and at every position a density of heading.

This is the output of networks with a location head and an orientation head; the joint density is the product.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, checked, keep_plain, read_only
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.interpolation import corners
from fusion.kernels.likelihood_mass import log_mass_of_maps
from fusion.likelihood import DEFAULT_FLOOR, LikelihoodVolume, OutlierMixture, checked_temperature
from fusion.particles.lookup import MOST_CELLS, Lookup


@dataclass(frozen=True, slots=True, eq=False)
class LocationOrientationMaps:
    """``p(x, y) * p(yaw | x, y)`` on a grid.

    Parameters
    ----------
    location : (rows, cols) float32
        ln density per m^2, ``sum(exp(location)) * pixel_area == 1``. Like `orientation` it is taken over, not copied:
        do not write to it afterwards.
    orientation : (K, rows, cols) float32
        ln density per rad at each position, ``sum over K of exp(orientation) * 2 pi / K == 1``; bin k is centred at
        ``2 pi k / K``.
    grid : MapGrid
        Where the pixels lie.
    confidence : float
        The network's own probability, in [0, 1], that its best pose is right; carried along, not applied.
    floor : float
        ln density per m^2 rad outside the crop, and the least inside it.

    Raises
    ------
    SkyfixError
        When shapes disagree with the grid or a value is not finite.
    """

    location: Float32Array
    orientation: Float32Array
    grid: MapGrid
    confidence: float = 1.0
    floor: float = DEFAULT_FLOOR

    def __post_init__(self) -> None:
        keep_plain(self, ["confidence", "floor"])
        location = np.ascontiguousarray(self.location, dtype=np.float32)
        orientation = np.ascontiguousarray(self.orientation, dtype=np.float32)
        plan = (self.grid.rows, self.grid.cols)
        if location.shape != plan:
            raise SkyfixError(f"location: expected {plan}, got {location.shape}")
        if orientation.ndim != 3 or orientation.shape[1:] != plan or orientation.shape[0] < 1:
            raise SkyfixError(f"orientation: expected (K, {plan[0]}, {plan[1]}), got {orientation.shape}")
        if not (np.isfinite(location).all() and np.isfinite(orientation).all() and np.isfinite(self.floor)):
            raise SkyfixError("location and orientation: expected finite log densities, got NaN or an infinity")
        if not 0.0 <= self.confidence <= 1.0:
            raise SkyfixError(f"confidence: expected in [0, 1], got {self.confidence}")
        object.__setattr__(self, "location", read_only(location))
        object.__setattr__(self, "orientation", read_only(orientation))

    @property
    def searched_volume(self) -> float:
        """The crop times all headings, m^2 rad."""
        return self.grid.area_m2 * se2.TWO_PI

    def lookup(self, temperature: float) -> Lookup | None:
        """What the compiled filter step reads: these arrays, and the constants of :meth:`tempered`."""
        bins, pixels = self.orientation.shape[0], self.location.size
        if self.orientation.size > MOST_CELLS:
            return None
        scale, shift = 1.0 / checked_temperature(temperature), 0.0
        location = self.location.reshape(-1)
        if scale != 1.0:
            mass = log_mass_of_maps(location, self.orientation.reshape(bins, pixels), np.float32(scale))
            shift = -(mass + float(np.log(self.grid.metres_per_pixel**2 * se2.TWO_PI / bins)))
        slots = np.arange(pixels, dtype=np.int32)
        table, floor = self.orientation.reshape(-1), self.floor
        return Lookup(table, self.grid, bins, scale, shift, floor, floor, location, slots, 1, pixels)

    def to_volume(self) -> LikelihoodVolume:
        """The joint density as one array of cells."""
        joint = self.location[:, :, None] + np.moveaxis(self.orientation, 0, 2)
        return LikelihoodVolume(np.maximum(joint, np.float32(self.floor)), self.grid, self.floor)

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """Trilinear interpolation of the joint log density at poses (N, 3), without building the joint array."""
        poses = checked("poses", poses, ("N", 3))
        bin_count, pixel_count = self.orientation.shape[0], self.location.size
        location, orientation = self.location.reshape(-1), self.orientation.reshape(-1)
        result = np.zeros(len(poses))
        for cell, pixel, weight in corners(self.grid, bin_count, poses):
            yaw_bin = cell - pixel * bin_count
            joint = location[pixel] + orientation[yaw_bin * pixel_count + pixel]
            result += weight * np.maximum(joint, self.floor)
        return np.where(self.grid.contains(poses[:, :2]), result, self.floor)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw a pixel by its mass, a heading bin given the pixel, then uniformly inside the cell; (n, 3)."""
        bin_count = self.orientation.shape[0]
        pixel = rng.choice(self.location.size, size=n, p=_softmax(self.location.reshape(-1), axis=0))
        row, col = np.divmod(pixel, self.grid.cols)
        cumulative = np.cumsum(_softmax(self.orientation[:, row, col], axis=0), axis=0)
        yaw_bin = np.minimum((cumulative < rng.random(n)).sum(axis=0), bin_count - 1)
        jitter = rng.random((n, 3))
        xy = self.grid.xy_from_pixel(np.stack([row, col], axis=-1) + jitter[:, :2])
        return np.column_stack([xy, se2.wrap((yaw_bin + jitter[:, 2] - 0.5) * se2.TWO_PI / bin_count)])

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """The log density (N,) of the cell that each pose (N, 3) lies in; the floor outside the crop."""
        poses = checked("poses", poses, ("N", 3))
        bins = self.orientation.shape[0]
        yaw_bin = np.rint(poses[:, 2] * (bins / se2.TWO_PI)).astype(np.int64) % bins
        inside = self.grid.contains(poses[:, :2])
        row, col = np.where(inside, self.grid.pixel_from_xy(poses[:, :2]).T, 0.0).astype(np.int64)
        row, col = np.minimum(row, self.grid.rows - 1), np.minimum(col, self.grid.cols - 1)
        joint = self.location[row, col].astype(np.float64) + self.orientation[yaw_bin, row, col]
        return np.where(inside, joint, self.floor)

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest modes of the joint density."""
        return self.to_volume().modes(k)

    def tempered(self, temperature: float) -> "LocationOrientationMaps":
        """The joint density to the power 1 / temperature; it factors again, with the headings' normaliser moved."""
        if checked_temperature(temperature) == 1.0:
            return self
        orientation = self.orientation.astype(np.float64) / temperature
        per_pixel = logsumexp(orientation, axis=0) + np.log(se2.TWO_PI / len(orientation))
        location = self.location.astype(np.float64) / temperature + per_pixel
        location -= logsumexp(location) + 2.0 * np.log(self.grid.metres_per_pixel)
        return LocationOrientationMaps(
            location.astype(np.float32),
            (orientation - per_pixel).astype(np.float32),
            self.grid,
            self.confidence,
            self.floor,
        )

    def with_outliers(self, probability: float) -> OutlierMixture:
        """Allow for a measurement that says nothing: mix in the uniform density over the crop."""
        return OutlierMixture(self, probability)


def _softmax(log_values: Float32Array, axis: int) -> FloatArray:
    values = log_values.astype(np.float64)
    return np.exp(values - logsumexp(values, axis=axis, keepdims=True))
