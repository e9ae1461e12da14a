"""Likelihoods over poses: what a localization network hands to a filter.

Every value is a natural-log density per m^2 rad under a uniform prior over the crop, so that it integrates to 1 over
crop x [-pi, pi). Where nothing was evaluated there is a floor, never -inf, so that no pose is ever ruled out.
"""

from dataclasses import dataclass, field
from math import isfinite
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import BoolArray, Float32Array, FloatArray, checked, keep_plain, read_only
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.interpolation import corners
from fusion.kernels.likelihood_mass import survey, tempered_mass
from fusion.modes import circular_run, find_modes
from fusion.particles.lookup import MOST_CELLS, Lookup

DEFAULT_FLOOR = -40.0


class PoseLikelihood(Protocol):
    """A density over poses (x, y, yaw) in the map frame."""

    @property
    def grid(self) -> MapGrid:
        """The crop that was searched."""
        ...

    @property
    def searched_volume(self) -> float:
        """Volume, m^2 rad, of the poses that were evaluated: the crop times the headings looked at."""
        ...

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) per m^2 rad at poses (N, 3); finite everywhere."""
        ...

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3) from the density."""
        ...

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) at poses (N, 3) of what `sample` draws from: `log_density` up to interpolation."""
        ...

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest modes."""
        ...

    def tempered(self, temperature: float) -> "PoseLikelihood":
        """The density to the power 1 / temperature, normalised again; flatter for a temperature above 1."""
        ...

    def with_outliers(self, probability: float) -> "PoseLikelihood":
        """The mixture with a uniform density over the crop, which has the given weight."""
        ...


def log_uniform_density(grid: MapGrid) -> float:
    """ln density of a pose that is uniform over the crop and over all headings."""
    return -float(np.log(grid.area_m2 * se2.TWO_PI))


def checked_temperature(temperature: float) -> float:
    """A temperature that can divide log densities: finite and positive, or SkyfixError."""
    if not (isfinite(temperature) and temperature > 0.0):
        raise SkyfixError(f"temperature: expected > 0, got {temperature}")
    return float(temperature)


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodVolume:
    """A joint density on a grid of cells.

    Parameters
    ----------
    log_prob : (rows, cols, K) float32
        ln density per m^2 rad at the cell centres, normalised: ``sum(exp(log_prob)) * cell_volume == 1``. Yaw bin k
        is centred at ``2 pi k / K``. Cells at `floor` or below were not evaluated. A C-contiguous array is taken over
        and not copied: do not write to it afterwards.
    grid : MapGrid
        Where the cells lie.
    floor : float
        ln density outside the crop and where nothing was evaluated. It is not evidence: tempering leaves it alone.

    Raises
    ------
    SkyfixError
        When the shape is not the grid's, a value is not finite, or no cell is above the floor.
    """

    log_prob: Float32Array
    grid: MapGrid
    floor: float = DEFAULT_FLOOR
    bin_peaks: FloatArray = field(init=False, repr=False)
    evaluated_cells: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        log_prob = np.ascontiguousarray(self.log_prob, dtype=np.float32)
        expected = (self.grid.rows, self.grid.cols)
        if log_prob.ndim != 3 or log_prob.shape[:2] != expected or log_prob.shape[2] < 1:
            raise SkyfixError(f"likelihood: expected ({expected[0]}, {expected[1]}, K), got {log_prob.shape}")
        floor = float(np.float32(self.floor))
        peaks, evaluated, bad = survey(read_only(log_prob).reshape(-1, log_prob.shape[2]), np.float32(floor))
        if bad or not np.isfinite(floor):
            raise SkyfixError("likelihood: expected finite log densities and floor, got NaN or an infinity")
        if peaks.max() <= floor:
            raise SkyfixError(f"likelihood: expected a cell above the floor of {floor:g}, got none")
        object.__setattr__(self, "log_prob", read_only(log_prob))
        object.__setattr__(self, "floor", floor)
        object.__setattr__(self, "bin_peaks", read_only(peaks.astype(np.float64)))
        object.__setattr__(self, "evaluated_cells", int(evaluated))

    @property
    def cell_volume(self) -> float:
        """Volume of a cell, m^2 rad."""
        return float(self.grid.metres_per_pixel**2 * se2.TWO_PI / self.log_prob.shape[2])

    @property
    def searched_volume(self) -> float:
        """Volume of the cells above the floor, m^2 rad."""
        return self.evaluated_cells * self.cell_volume

    def lookup(self, temperature: float) -> Lookup | None:
        """What the compiled filter step reads: this array, and the constants of :meth:`tempered`."""
        bins = self.log_prob.shape[2]
        if self.log_prob.size > MOST_CELLS:
            return None
        table, floor, scale, shift = self.log_prob.reshape(-1), self.floor, 1.0, 0.0
        if checked_temperature(temperature) != 1.0:
            peak = float(self.bin_peaks.max())
            scale = 1.0 / temperature
            mass, least = tempered_mass(table, np.float32(floor), np.float32(peak), np.float32(scale))
            shift = -scale * peak - float(np.log(mass * self.cell_volume))
            floor = min(floor, scale * float(least) + shift - 1.0)
        return Lookup(table, self.grid, bins, scale, shift, self.floor, floor)

    @classmethod
    def from_scores(
        cls, scores: ArrayLike, grid: MapGrid, temperature: float = 1.0, valid: ArrayLike | None = None
    ) -> Self:
        """Density from unnormalised log scores: a softmax over the valid cells, divided by the cell volume.

        Parameters
        ----------
        scores : (rows, cols, K) array_like
            Higher is likelier. Values at invalid cells are ignored and may be NaN.
        grid : MapGrid
            Where the cells lie.
        temperature : float
            Divides the scores; above 1 it makes a sharp network less sure of itself.
        valid : bool array_like, optional
            Cells that were evaluated; broadcasts to the scores, so (K,) says it per yaw bin and (rows, cols, 1) per
            position. All are when left out.

        Raises
        ------
        SkyfixError
            When shapes disagree, no cell is valid, or a valid score is not finite.
        """
        checked_temperature(temperature)
        scores = np.asarray(scores, dtype=np.float32)
        if scores.ndim != 3 or scores.shape[:2] != (grid.rows, grid.cols) or scores.shape[2] < 1:
            raise SkyfixError(f"scores: expected ({grid.rows}, {grid.cols}, K), got {scores.shape}")
        mask = _broadcast_mask(valid, scores.shape)
        cell_volume = grid.metres_per_pixel**2 * se2.TWO_PI / scores.shape[2]
        chosen = scores[mask].astype(np.float64) / temperature
        if len(chosen) == 0:
            raise SkyfixError("valid: expected at least one valid cell, got none")
        if not np.isfinite(chosen).all():
            raise SkyfixError("scores: expected finite values at the valid cells, got NaN or an infinity")
        chosen -= logsumexp(chosen) + np.log(cell_volume)
        floor = min(DEFAULT_FLOOR, float(chosen.min()) - 1.0)
        log_prob = np.full(scores.shape, floor, dtype=np.float32)
        log_prob[mask] = chosen
        return cls(log_prob, grid, floor)

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """Trilinear interpolation of the log densities at poses (N, 3), circular in yaw.

        Between the outermost cell centres and the edge of the crop the edge cell's value holds; outside the crop the
        floor.
        """
        poses = checked("poses", poses, ("N", 3))
        values = self.log_prob.reshape(-1)
        result = np.zeros(len(poses))
        for cell, _, weight in corners(self.grid, self.log_prob.shape[2], poses):
            result += weight * values[cell]
        return np.where(self.grid.contains(poses[:, :2]), np.maximum(result, self.floor), self.floor)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw cells by their mass, then a pose uniformly inside each; (n, 3)."""
        bin_count = self.log_prob.shape[2]
        bins = circular_run(self.bin_peaks > self.floor)
        log_prob = self.log_prob if len(bins) == bin_count else self.log_prob.take(bins, axis=2)
        cumulative = np.cumsum(np.exp(log_prob - self.bin_peaks.max(), dtype=np.float64))
        drawn = np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")
        row, col, run = np.unravel_index(np.minimum(drawn, log_prob.size - 1), log_prob.shape)
        yaw_bin = run if len(bins) == bin_count else bins[run]
        jitter = rng.random((n, 3))
        xy = self.grid.xy_from_pixel(np.stack([row, col], axis=-1) + jitter[:, :2])
        yaw = se2.wrap((yaw_bin + jitter[:, 2] - 0.5) * se2.TWO_PI / bin_count)
        return np.column_stack([xy, yaw])

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """The log density (N,) of the cell that each pose (N, 3) lies in; the floor outside the crop."""
        poses = checked("poses", poses, ("N", 3))
        bins = self.log_prob.shape[2]
        yaw_bin = np.rint(poses[:, 2] * (bins / se2.TWO_PI)).astype(np.int64) % bins
        inside = self.grid.contains(poses[:, :2])
        row, col = np.where(inside, self.grid.pixel_from_xy(poses[:, :2]).T, 0.0).astype(np.int64)
        row, col = np.minimum(row, self.grid.rows - 1), np.minimum(col, self.grid.cols - 1)
        return np.where(inside, self.log_prob[row, col, yaw_bin].astype(np.float64), self.floor)

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest modes, as Gaussians with the moments of the mass around them."""
        return find_modes(self, k)

    def tempered(self, temperature: float) -> "LikelihoodVolume":
        """Divide the log densities of the evaluated cells by `temperature` and normalise again."""
        if checked_temperature(temperature) == 1.0:
            return self
        bins = circular_run(self.bin_peaks > self.floor)
        part = self.log_prob if len(bins) == self.log_prob.shape[2] else self.log_prob.take(bins, axis=2)
        evaluated = part > self.floor
        scaled = (part - np.float32(self.bin_peaks.max())) / np.float32(temperature)
        mass = np.exp(scaled).sum(where=evaluated, dtype=np.float64)
        scaled -= np.float32(np.log(mass * self.cell_volume))
        floor = min(self.floor, float(scaled.min(where=evaluated, initial=np.inf)) - 1.0)
        scaled[~evaluated] = floor
        if len(bins) == self.log_prob.shape[2]:
            return LikelihoodVolume(scaled, self.grid, floor)
        log_prob = np.full(self.log_prob.shape, floor, dtype=np.float32)
        log_prob[:, :, bins] = scaled
        return LikelihoodVolume(log_prob, self.grid, floor)

    def with_outliers(self, probability: float) -> "OutlierMixture":
        """Allow for a measurement that says nothing: mix in the uniform density over the crop."""
        return OutlierMixture(self, probability)


def _broadcast_mask(valid: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    if valid is None:
        return np.ones(shape, dtype=np.bool_)
    mask: NDArray[np.bool_] = np.asarray(valid, dtype=np.bool_)
    try:
        return np.broadcast_to(mask, shape)
    except ValueError as error:
        raise SkyfixError(f"valid: expected a mask that broadcasts to {shape}, got {mask.shape}") from error


@dataclass(frozen=True, slots=True, eq=False)
class OutlierMixture:
    """``(1 - p) * likelihood + p * uniform``: a likelihood that is sometimes about nothing.

    The uniform part is ``1 / (crop area * 2 pi)`` and holds everywhere, outside the crop too, where it is the floor.

    Parameters
    ----------
    likelihood : PoseLikelihood
        The measurement when it is right.
    probability : float
        Chance p that it is not, in [0, 1).

    Raises
    ------
    SkyfixError
        When the probability is out of range.
    """

    likelihood: PoseLikelihood
    probability: float

    def __post_init__(self) -> None:
        keep_plain(self, ["probability"])
        if not 0.0 <= self.probability < 1.0:
            raise SkyfixError(f"outlier probability: expected in [0, 1), got {self.probability}")

    @property
    def grid(self) -> MapGrid:
        """The crop that was searched."""
        return self.likelihood.grid

    @property
    def searched_volume(self) -> float:
        """That of the likelihood."""
        return self.likelihood.searched_volume

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) of the mixture at poses (N, 3)."""
        inner = self.likelihood.log_density(poses)
        if self.probability == 0.0:
            return inner
        uniform = np.log(self.probability) + log_uniform_density(self.grid)
        return np.logaddexp(np.log1p(-self.probability) + inner, uniform)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3): each uniform over the crop with the outlier probability, else from the likelihood."""
        poses = self.likelihood.sample(n, rng)
        outlier = rng.random(n) < self.probability
        unit = rng.random((n, 3))
        xy = self.grid.xy_from_pixel(unit[:, :2] * (self.grid.rows, self.grid.cols))
        uniform = np.column_stack([xy, se2.wrap(unit[:, 2] * se2.TWO_PI)])
        return np.where(outlier[:, None], uniform, poses)

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """That of the likelihood, and outliers inside the crop only."""
        poses = checked("poses", poses, ("N", 3))
        inner = self.likelihood.draw_log_density(poses)
        if self.probability == 0.0:
            return inner
        uniform = np.where(self.grid.contains(poses[:, :2]), np.log(self.probability), DEFAULT_FLOOR)
        return np.logaddexp(np.log1p(-self.probability) + inner, uniform + log_uniform_density(self.grid))

    def modes(self, k: int) -> GaussianMixture:
        """The modes of the likelihood, their weights times 1 - p."""
        inner = self.likelihood.modes(k)
        return GaussianMixture((1.0 - self.probability) * inner.weights, inner.means, inner.covariances)

    def tempered(self, temperature: float) -> "OutlierMixture":
        """Temper the likelihood and keep the outlier probability: the two say different things."""
        return OutlierMixture(self.likelihood.tempered(temperature), self.probability)

    def with_outliers(self, probability: float) -> "OutlierMixture":
        """Both chances of an outlier together."""
        return OutlierMixture(self.likelihood, 1.0 - (1.0 - self.probability) * (1.0 - probability))
