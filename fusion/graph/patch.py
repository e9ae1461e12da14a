"""LikelihoodPatch: the part of a likelihood that matters to a smoother, small enough to keep for a whole drive."""

from dataclasses import dataclass, replace
from functools import singledispatch

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume, OutlierMixture, PoseLikelihood, log_uniform_density
from fusion.modes import circular_run

_SAMPLED_BINS = 360
_RANGE_NATS = 25.0  # below the peak; deeper is as good as impossible, and steep walls make bad derivatives


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Poses within `half_extent_m` (a square) and `half_heading_rad` of a centre (3,): what to keep of a likelihood."""

    centre: FloatArray
    half_extent_m: float
    half_heading_rad: float = np.pi

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", checked("neighbourhood centre", self.centre, (3,)))
        if not (self.half_extent_m > 0.0 and self.half_heading_rad > 0.0):
            got = f"{self.half_extent_m} m, {self.half_heading_rad} rad"
            raise SkyfixError(f"neighbourhood: expected extents > 0, got {got}")


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodPatch:
    """ln densities of the cells around some poses.

    Parameters
    ----------
    log_prob : (rows, cols, bins) float32
        Per m^2 rad; as in `LikelihoodVolume`, but bins of a part of the circle only.
    grid : MapGrid
        Where the cells lie.
    first_bin, bin_count : int
        The bins are ``first_bin, first_bin + 1, ...`` of `bin_count` on the whole circle.
    floor : float
        ln density elsewhere.
    log_uniform : float
        ln density of a measurement that says nothing, see `fusion.likelihood.log_uniform_density`.
    outlier_probability : float
        Chance, in [0, 1), that this one says nothing, beside what a smoother's settings say of all.

    Raises
    ------
    SkyfixError
        When shapes disagree, a value is not finite, or the probability is out of range.
    """

    log_prob: Float32Array
    grid: MapGrid
    first_bin: int
    bin_count: int
    floor: float
    log_uniform: float
    outlier_probability: float = 0.0

    def __post_init__(self) -> None:
        log_prob = np.ascontiguousarray(self.log_prob, dtype=np.float32)
        rows, cols = self.grid.rows, self.grid.cols
        if log_prob.ndim != 3 or log_prob.shape[:2] != (rows, cols) or not 1 <= log_prob.shape[2] <= self.bin_count:
            most = self.bin_count
            raise SkyfixError(f"patch: expected ({rows}, {cols}, 1 to {most}) log densities, got {log_prob.shape}")
        if not (np.isfinite(log_prob).all() and np.isfinite(self.floor) and np.isfinite(self.log_uniform)):
            raise SkyfixError("patch: expected finite log densities, got NaN or an infinity")
        if not 0.0 <= self.outlier_probability < 1.0:
            raise SkyfixError(f"patch outlier probability: expected in [0, 1), got {self.outlier_probability}")
        object.__setattr__(self, "log_prob", read_only(log_prob))

    @property
    def wraps(self) -> bool:
        """Whether the bins close to a circle."""
        return self.log_prob.shape[2] == self.bin_count

    @property
    def first_centre(self) -> tuple[float, float, float]:
        """x, y and yaw of the centre of the first cell."""
        grid, half = self.grid, 0.5 * self.grid.metres_per_pixel
        return grid.x0 + half, grid.y0 + grid.height_m - half, self.first_bin * se2.TWO_PI / self.bin_count


def either(p: FloatArray | float, q: FloatArray | float) -> FloatArray | float:
    """The chance of an outlier by one cause or another, as `OutlierMixture.with_outliers` has it; just p for q = 0."""
    return p + q - p * q


def without_outliers(likelihood: PoseLikelihood) -> tuple[PoseLikelihood, float]:
    """What is inside of an outlier mixture, and the outlier probability; a likelihood of another type itself, and 0."""
    if not isinstance(likelihood, OutlierMixture):
        return likelihood, 0.0
    inner, probability = without_outliers(likelihood.likelihood)
    return inner, float(either(likelihood.probability, probability))


def patch_of(likelihood: PoseLikelihood | LikelihoodPatch, around: Neighbourhood | None = None) -> LikelihoodPatch:
    """What is to be kept of a likelihood that has been tempered for errors correlated in time.

    Parameters
    ----------
    likelihood : PoseLikelihood
        A volume is cut out of; any other is sampled at the pixels of its grid and every degree. An outlier mixture
        gives the likelihood inside with the outlier probability. A patch stays as it is.
    around : Neighbourhood, optional
        Where the pose may be. Everything that was evaluated is kept when left out.
    """
    if isinstance(likelihood, LikelihoodPatch):
        return likelihood
    inner, probability = without_outliers(likelihood)
    patch = _patch(inner, around)
    return replace(patch, outlier_probability=probability) if probability else patch


@singledispatch
def _patch(likelihood: PoseLikelihood, around: Neighbourhood | None) -> LikelihoodPatch:
    grid = likelihood.grid
    rows, cols = _pixels(grid, around)
    bins = _bins(np.arange(_SAMPLED_BINS), _SAMPLED_BINS, around)
    part = _part(grid, rows, cols)
    x, y = part.centres()
    poses = np.stack(np.meshgrid(y, x, bins * se2.TWO_PI / _SAMPLED_BINS, indexing="ij"), axis=-1)[..., [1, 0, 2]]
    values = np.asarray(likelihood.log_density(poses.reshape(-1, 3))).reshape(poses.shape[:3])
    return _finished(values, part, int(bins[0]), _SAMPLED_BINS, float(values.min()), grid)


@_patch.register
def _(likelihood: LikelihoodVolume, around: Neighbourhood | None) -> LikelihoodPatch:
    grid, log_prob, floor = likelihood.grid, likelihood.log_prob, likelihood.floor
    rows, cols = _pixels(grid, around)
    bins = _bins(circular_run(likelihood.bin_peaks > floor), log_prob.shape[2], around)
    values = log_prob[rows[0] : rows[1], cols[0] : cols[1]].take(bins, axis=2)
    return _finished(values, _part(grid, rows, cols), int(bins[0]), log_prob.shape[2], floor, grid)


def _finished(
    values: ArrayLike, part: MapGrid, first_bin: int, bin_count: int, floor: float, grid: MapGrid
) -> LikelihoodPatch:
    values = np.asarray(values, dtype=np.float32)
    lowest = max(floor, float(values.max()) - _RANGE_NATS)
    uniform = log_uniform_density(grid)
    return LikelihoodPatch(np.maximum(values, lowest), part, first_bin, bin_count, lowest, uniform)


def _pixels(grid: MapGrid, around: Neighbourhood | None) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and past-the-last row and column to keep, at least one of each."""
    if around is None:
        return (0, grid.rows), (0, grid.cols)
    row, col = np.floor(grid.pixel_from_xy(around.centre[:2])).astype(np.int64)
    half = int(np.ceil(around.half_extent_m / grid.metres_per_pixel))
    return _run(int(row), half, grid.rows), _run(int(col), half, grid.cols)


def _run(middle: int, half: int, count: int) -> tuple[int, int]:
    first = min(max(middle - half, 0), count - 1)
    return first, max(min(middle + half + 1, count), first + 1)


def _bins(evaluated: IntArray, bin_count: int, around: Neighbourhood | None) -> IntArray:
    """The evaluated bins, in running order, that are near enough; the nearest when none is."""
    if around is None:
        return evaluated
    off = np.abs(se2.wrap(evaluated * (se2.TWO_PI / bin_count) - around.centre[2]))
    reach = max(around.half_heading_rad, float(off.min())) + 1e-9
    near = np.zeros(bin_count, dtype=np.bool_)
    near[evaluated[off <= reach]] = True
    return np.arange(bin_count) if near.all() else circular_run(near)


def _part(grid: MapGrid, rows: tuple[int, int], cols: tuple[int, int]) -> MapGrid:
    x0, y0 = grid.xy_from_pixel((float(rows[1]), float(cols[0]))).tolist()
    return MapGrid(rows[1] - rows[0], cols[1] - cols[0], grid.metres_per_pixel, x0, y0)
