"""A factored likelihood whose heading part is worked out only where somebody asks: features and a 1 x 1 convolution.

The orientation head of a network is a (K, C) matrix applied to the C features of every pixel. For K = 360 headings on
256 x 256 pixels that is 94 MB a frame, while a filter in tracking touches a few hundred pixels. Here

    p(yaw | pixel) = softmax over K of (W f(pixel) + b) * K / (2 pi)

is evaluated for the pixels around the poses that are asked about, and for no others.

Tempered, p(x, y) p(yaw | x, y) to the power q = 1 / T has the normaliser

    Z = sum over pixels of p(x, y)^q S(x, y) * pixel area,    S = integral of p(yaw | x, y)^q

which asks for the headings wherever there is mass. S is at most (2 pi)^(1 - q) for q < 1, by Jensen's inequality, and
at most (K / 2 pi)^(q - 1) otherwise. So pixels are summed from the likeliest on, and no more once all that are left
cannot change Z by a millionth. Where a location map is peaked that is a few of them; one with a broad background at a
high temperature has its mass everywhere, and is then summed everywhere, once, a block of pixels at a time.
"""

from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.likelihood import DEFAULT_FLOOR, OutlierMixture, checked_temperature
from fusion.location_orientation import LocationOrientationMaps
from fusion.particles.lookup import MOST_CELLS, Lookup

_NEGLIGIBLE = 1e-6  # share of the mass that is left out of a normaliser: float32 holds no less
_BLOCK = 256  # pixels whose headings are worked out at once for it


@dataclass(frozen=True, slots=True, eq=False)
class LazyOrientation:
    """``p(x, y) * p(yaw | x, y)`` with the second factor as features and a linear head.

    Parameters
    ----------
    location : (rows, cols) float32
        ln density per m^2, ``sum(exp(location)) * pixel_area == 1``.
    features : (C, rows, cols) float32
        What the head sees at every pixel.
    weights : (K, C) float32
        The head; heading k is centred at ``2 pi k / K``.
    bias : (K,) float32
        Of the head.
    grid : MapGrid
        Where the pixels lie.
    floor : float
        ln density per m^2 rad outside the crop, and the least inside it.

    Attributes
    ----------
    temperature : float
        The density is the joint one above to the power 1 / temperature, normalised again; 1 but for :meth:`tempered`.
    log_partition : float
        ln of the integral of that power.

    Raises
    ------
    SkyfixError
        When shapes disagree or a value is not finite.
    """

    location: Float32Array
    features: Float32Array
    weights: Float32Array
    bias: Float32Array
    grid: MapGrid
    floor: float = DEFAULT_FLOOR
    temperature: float = field(init=False, default=1.0)
    log_partition: float = field(init=False, default=0.0, repr=False)
    _drawn_pixels: IntArray = field(init=False, repr=False)
    _drawn_log_mass: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        plan = (self.grid.rows, self.grid.cols)
        shapes = {"location": plan, "features": ("C", *plan), "weights": ("K", "C"), "bias": ("K",)}
        for name, shape in shapes.items():
            array = checked(name, getattr(self, name), shape)
            object.__setattr__(self, name, read_only(np.ascontiguousarray(array, dtype=np.float32)))
        headings, channels = self.weights.shape
        if channels != len(self.features) or headings != len(self.bias) or headings < 1:
            expected = f"({len(self.bias)}, {len(self.features)})"
            raise SkyfixError(f"weights: expected {expected} for the bias and the features, got {self.weights.shape}")
        if not np.isfinite(self.floor):
            raise SkyfixError(f"likelihood: expected a finite floor, got {self.floor}")
        object.__setattr__(self, "_drawn_pixels", np.arange(self.location.size))
        object.__setattr__(self, "_drawn_log_mass", self.location.reshape(-1).astype(np.float64))

    @property
    def searched_volume(self) -> float:
        """The crop times all headings, m^2 rad."""
        return self.grid.area_m2 * se2.TWO_PI

    def headings_at(self, pixels: IntArray) -> Float32Array:
        """ln density per rad (M, K) of the headings at flat pixels (M,), at temperature 1."""
        logits = self.features.reshape(len(self.features), -1)[:, pixels].T @ self.weights.T + self.bias
        normaliser = logsumexp(logits, axis=1, keepdims=True) + np.log(se2.TWO_PI / len(self.bias))
        return np.ascontiguousarray(logits - normaliser, dtype=np.float32)

    def lookup_near(self, poses: FloatArray, temperature: float = 1.0) -> Lookup | None:
        """What the compiled filter step reads of :meth:`tempered`, with headings only around poses (N, 3).

        None when that is too many cells.
        """
        whole = self.tempered(temperature)
        pixels = self._touched(poses)
        if len(pixels) * len(self.bias) > MOST_CELLS:
            return None
        slots = np.zeros(self.location.size, dtype=np.int32)
        slots[pixels] = np.arange(len(pixels), dtype=np.int32)
        table, bins = self.headings_at(pixels).reshape(-1), len(self.bias)
        location = self.location.reshape(-1)
        scale, shift = 1.0 / whole.temperature, 0.0 - whole.log_partition
        return Lookup(table, self.grid, bins, scale, shift, self.floor, self.floor, location, slots, bins, 1)

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """Trilinear interpolation of the joint log density at poses (N, 3), as `LocationOrientationMaps` does it."""
        poses = checked("poses", poses, ("N", 3))
        if len(poses) == 0:
            return np.zeros(0)
        row, col = self._pixels(poses)
        top, left = max(int(row.min()) - 1, 0), max(int(col.min()) - 1, 0)
        bottom, right = min(int(row.max()) + 2, self.grid.rows), min(int(col.max()) + 2, self.grid.cols)
        rows, cols = np.divmod(self._touched(poses), self.grid.cols)
        headings = np.zeros((len(self.bias), bottom - top, right - left), dtype=np.float32)
        headings[:, rows - top, cols - left] = self.headings_at(rows * self.grid.cols + cols).T
        step = self.grid.metres_per_pixel
        y0 = self.grid.y0 + (self.grid.rows - bottom) * step
        window = MapGrid(bottom - top, right - left, step, self.grid.x0 + left * step, y0)
        location = self.location[top:bottom, left:right] / self.temperature - self.log_partition
        near = LocationOrientationMaps(location, headings / self.temperature, window, floor=self.floor)
        inside = self.grid.contains(poses[:, :2])
        return np.where(inside, near.log_density(poses), self.floor)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw a pixel by its mass, a heading given the pixel, then uniformly inside the cell; (n, 3)."""
        mass = np.exp(self._drawn_log_mass - self._drawn_log_mass.max())
        pixels = self._drawn_pixels[rng.choice(len(mass), size=n, p=mass / mass.sum())]
        distinct, place = np.unique(pixels, return_inverse=True)
        headings = self.headings_at(distinct).astype(np.float64)
        headings -= headings.max(axis=1, keepdims=True)
        cumulative = np.cumsum(np.exp(headings / self.temperature), axis=1)
        cumulative /= cumulative[:, -1:]
        bins = len(self.bias)
        yaw_bin = np.minimum((cumulative[place] <= rng.random((n, 1))).sum(axis=1), bins - 1)
        row, col = np.divmod(pixels, self.grid.cols)
        jitter = rng.random((n, 3))
        xy = self.grid.xy_from_pixel(np.stack([row, col], axis=-1) + jitter[:, :2])
        return np.column_stack([xy, se2.wrap((yaw_bin + jitter[:, 2] - 0.5) * se2.TWO_PI / bins)])

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """The log density (N,) of the cell that each pose (N, 3) lies in; the floor outside the crop."""
        poses = checked("poses", poses, ("N", 3))
        row, col = self._pixels(poses)
        distinct, place = np.unique(row * self.grid.cols + col, return_inverse=True)
        bins = len(self.bias)
        yaw_bin = np.rint(poses[:, 2] * (bins / se2.TWO_PI)).astype(np.int64) % bins
        joint = self.location[row, col].astype(np.float64) + self.headings_at(distinct)[place, yaw_bin]
        joint = joint / self.temperature - self.log_partition
        return np.where(self.grid.contains(poses[:, :2]), joint, self.floor)

    def to_maps(self) -> LocationOrientationMaps:
        """The same with the head evaluated everywhere."""
        headings = self.headings_at(np.arange(self.location.size))
        shape = (len(self.bias), self.grid.rows, self.grid.cols)
        whole = LocationOrientationMaps(self.location, headings.T.reshape(shape), self.grid, floor=self.floor)
        return whole.tempered(self.temperature)

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest modes of the joint density; evaluates the head everywhere."""
        return self.to_maps().modes(k)

    def tempered(self, temperature: float) -> "LazyOrientation":
        """The joint density to the power 1 / temperature, as `LocationOrientationMaps` tempers it.

        The normaliser is joint too: headings are worked out where the tempered density has its mass, see above.
        """
        if checked_temperature(temperature) == 1.0:
            return self
        same = copy(self)
        total = self.temperature * temperature
        pixels, log_mass = self._mass(1.0 / total)
        partition = float(logsumexp(log_mass)) + 2.0 * float(np.log(self.grid.metres_per_pixel))
        values = {
            "temperature": total,
            "log_partition": partition,
            "_drawn_pixels": pixels,
            "_drawn_log_mass": log_mass,
        }
        for name, value in values.items():
            object.__setattr__(same, name, value)
        return same

    def with_outliers(self, probability: float) -> OutlierMixture:
        """Allow for a measurement that says nothing: mix in the uniform density over the crop."""
        return OutlierMixture(self, probability)

    def _mass(self, power: float) -> tuple[IntArray, FloatArray]:
        """Flat pixels (M,) that hold the mass of the density to a power but for a millionth, and ln of each one's."""
        location, bins = self.location.reshape(-1), len(self.bias)
        order = np.argsort(-location, kind="stable")
        at = power * location[order].astype(np.float64)
        most = (1.0 - power) * np.log(se2.TWO_PI if power < 1.0 else se2.TWO_PI / bins)
        with np.errstate(divide="ignore"):
            rest = at[0] + most + np.log(np.cumsum(np.exp(at - at[0])[::-1])[::-1])
        found: list[FloatArray] = []
        total, begin = -np.inf, 0
        while begin < len(order) and rest[begin] > total + np.log(_NEGLIGIBLE):
            headings = power * self.headings_at(order[begin : begin + _BLOCK])
            peaks = headings.max(axis=1)
            integrals = np.exp(headings - peaks[:, None]).sum(axis=1, dtype=np.float64) * (se2.TWO_PI / bins)
            found.append(at[begin : begin + _BLOCK] + peaks + np.log(integrals))
            total = np.logaddexp(total, logsumexp(found[-1]))
            begin += _BLOCK
        log_mass = np.concatenate(found)
        return order[: len(log_mass)], log_mass

    def _pixels(self, poses: FloatArray) -> tuple[IntArray, IntArray]:
        """Row and column (N,) of the pixel that each pose lies in, or the nearest one."""
        last = (self.grid.rows - 1, self.grid.cols - 1)
        row_col = np.clip(np.floor(self.grid.pixel_from_xy(poses[:, :2])), 0, last).astype(np.int64)
        return row_col[:, 0], row_col[:, 1]

    def _touched(self, poses: FloatArray) -> IntArray:
        """Flat pixels, sorted, that interpolation at poses (N, 3) can touch: those the poses lie in and around them."""
        row, col = self._pixels(poses)
        seen: NDArray[np.bool_] = np.zeros((self.grid.rows, self.grid.cols), dtype=np.bool_)
        seen[row, col] = True
        wide = seen.copy()
        wide[1:] |= seen[:-1]
        wide[:-1] |= seen[1:]
        seen = wide.copy()
        wide[:, 1:] |= seen[:, :-1]
        wide[:, :-1] |= seen[:, 1:]
        return np.flatnonzero(wide)
