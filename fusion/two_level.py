"""A likelihood over a large region on two levels: coarse cells everywhere, and fine cells inside the best of them.

A whole map on fine cells would be gigabytes, and all but a few cells would hold nothing. Here every coarse cell has one
log density, and those that were looked at closely are cut into fine cells instead. A coarse cell's density is the mean
over its volume: that blur is all that is claimed where nobody looked closer. The two levels are one density, which
integrates to 1, so that particles in far-apart places are weighed against each other, and those between them as well.

Cell (r, c, k) of the coarse level is made of ``divisor^2`` by ``yaw_divisor`` fine cells. Both numbers are odd, so that
the centre of a coarse cell is the centre of its middle fine cell: coarse yaw bin k is centred at ``2 pi k / K`` too.

Source: the adaptive cells of Burgard, Derr, Fox, Cremers, "Integrating global position estimation and position tracking
for mobile robots: the dynamic Markov localization approach", IROS 1998, on two levels.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray, checked, keep_plain, read_only
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.interpolation import corners
from fusion.likelihood import DEFAULT_FLOOR, LikelihoodVolume, OutlierMixture, checked_temperature

_RANGE_NATS = 12.0  # fine cells this far below the peak hold no mass worth counting
_SEPARATION_M, _SEPARATION_RAD = 3.0, float(np.deg2rad(10.0))  # of two modes, as in `fusion.modes`
_MODE_REACH = 2.0  # a mode's mass lies within so many separations of its peak


@dataclass(frozen=True, slots=True, eq=False)
class TwoLevelLikelihood:
    """A joint density on coarse cells, some of which are cut into fine ones.

    Parameters
    ----------
    coarse : (rows, cols, K) float32
        ln density per m^2 rad of the cells; that of a cell which is cut is not read.
    grid : MapGrid
        Of the coarse cells.
    cut : (M, 3) int64
        Row, column and yaw bin of the cells that are cut, each at most once.
    fine : (M, divisor, divisor, yaw_divisor) float32
        ln density per m^2 rad of their fine cells, rows, columns and yaw bins in rising order.
    floor : float
        ln density outside the grid.

    Raises
    ------
    SkyfixError
        When shapes disagree, a divisor is even, a cell is cut twice, a value is not finite, or the density does not
        integrate to 1.
    """

    coarse: Float32Array
    grid: MapGrid
    cut: IntArray
    fine: Float32Array
    floor: float = DEFAULT_FLOOR
    fine_grid: MapGrid = field(init=False, repr=False)
    _place: NDArray[np.int32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        keep_plain(self, ["floor"])
        coarse = np.ascontiguousarray(self.coarse, np.float32)
        fine, cut = np.ascontiguousarray(self.fine, np.float32), np.ascontiguousarray(self.cut, np.int64)
        rows, cols = self.grid.rows, self.grid.cols
        if coarse.ndim != 3 or coarse.shape[:2] != (rows, cols) or coarse.shape[2] < 1:
            raise SkyfixError(f"coarse likelihood: expected ({rows}, {cols}, K), got {coarse.shape}")
        if fine.ndim != 4 or fine.shape[1] != fine.shape[2] or fine.shape[1] % 2 == 0 or fine.shape[3] % 2 == 0:
            raise SkyfixError(f"fine likelihood: expected (M, n, n, k) with n and k odd, got {fine.shape}")
        if cut.shape != (len(fine), 3):
            raise SkyfixError(f"cut cells: expected ({len(fine)}, 3), got {cut.shape}")
        if not (np.isfinite(coarse).all() and np.isfinite(fine).all() and np.isfinite(self.floor)):
            raise SkyfixError("likelihood: expected finite log densities and floor, got NaN or an infinity")
        place = np.full(coarse.size, -1, np.int32)
        flat = np.ravel_multi_index(tuple(cut.T), coarse.shape) if len(cut) else np.zeros(0, np.int64)
        place[flat] = np.arange(len(cut), dtype=np.int32)
        if len(np.unique(flat)) != len(flat):
            raise SkyfixError("cut cells: expected each at most once, got one twice")
        divisor = fine.shape[1]
        fine_grid = MapGrid(
            rows * divisor, cols * divisor, self.grid.metres_per_pixel / divisor, self.grid.x0, self.grid.y0
        )
        for name, value in (("coarse", coarse), ("fine", fine), ("cut", cut), ("_place", place)):
            object.__setattr__(self, name, read_only(value))
        object.__setattr__(self, "fine_grid", fine_grid)
        if abs(mass := float(np.exp(self._log_mass()))) > 1.0 + 1e-3 or mass < 1.0 - 1e-3:
            raise SkyfixError(f"likelihood: expected a density that integrates to 1, got one to {mass:.4g}")

    @classmethod
    def from_scores(
        cls, coarse: Float32Array, grid: MapGrid, cut: IntArray, fine: Float32Array, floor: float = DEFAULT_FLOOR
    ) -> "TwoLevelLikelihood":
        """Density from unnormalised log densities of both levels, which are of one scale."""
        coarse, fine = np.asarray(coarse, np.float32), np.asarray(fine, np.float32)
        total = np.float32(_log_mass(coarse, grid, cut, fine))
        if not np.isfinite(total):
            raise SkyfixError("scores: expected finite values, got NaN or an infinity")
        normalised, cells = coarse - total, fine - total
        least = min(float(normalised.min()), float(cells.min(initial=0.0)))
        return cls(normalised, grid, cut, cells, min(floor, least - 1.0))

    @property
    def cell_volume(self) -> float:
        """Volume of a coarse cell, m^2 rad."""
        return _cell_volume(self.grid, self.coarse.shape[2])

    @property
    def fine_volume(self) -> float:
        """Volume of a fine cell, m^2 rad."""
        return self.cell_volume / float(np.prod(self.fine.shape[1:]))

    @property
    def searched_volume(self) -> float:
        """Volume of the grid times all headings, m^2 rad: all of it was evaluated, coarsely at least."""
        return self.cell_volume * self.coarse.size

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """Trilinear interpolation between fine cells at poses (N, 3); an uncut cell's are all alike."""
        poses = checked("poses", poses, ("N", 3))
        result = np.zeros(len(poses))
        for cell, pixel, weight in corners(self.fine_grid, self._fine_bins, poses):
            row, col = np.divmod(pixel, self.fine_grid.cols)
            result += weight * self._at(row, col, cell - pixel * self._fine_bins)
        return np.where(self.grid.contains(poses[:, :2]), np.maximum(result, self.floor), self.floor)

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """The log density (N,) of the fine cell that each pose (N, 3) lies in; the floor outside the grid."""
        poses = checked("poses", poses, ("N", 3))
        inside = self.grid.contains(poses[:, :2])
        row_col = np.where(inside[:, None], self.fine_grid.pixel_from_xy(poses[:, :2]), 0.0).astype(np.int64)
        row_col = np.minimum(row_col, [self.fine_grid.rows - 1, self.fine_grid.cols - 1])
        yaw_bin = np.rint(poses[:, 2] * (self._fine_bins / se2.TWO_PI)).astype(np.int64) % self._fine_bins
        return np.where(inside, self._at(row_col[:, 0], row_col[:, 1], yaw_bin), self.floor)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw cells by their mass, then a pose uniformly inside each; (n, 3)."""
        peak = max(float(self.coarse.max()), float(self.fine.max(initial=-np.inf)))
        mass = np.exp(self.coarse.reshape(-1) - np.float32(peak), dtype=np.float32).astype(np.float64)
        mass *= self.cell_volume
        mass[self._place >= 0] = 0.0
        fine_mass = np.exp(self.fine.reshape(-1) - peak, dtype=np.float64) * self.fine_volume
        cumulative = np.cumsum(np.concatenate([fine_mass, mass]))
        drawn = np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")
        drawn = np.minimum(drawn, len(cumulative) - 1)
        jitter = rng.random((n, 3))
        is_fine = drawn < len(fine_mass)
        corner, width = np.empty((n, 3)), np.empty((n, 3))
        corner[is_fine] = self._fine_index(drawn[is_fine])
        width[is_fine] = 1.0
        row, col, yaw = np.unravel_index(drawn[~is_fine] - len(fine_mass), self.coarse.shape)
        sides = np.array([self.fine.shape[1], self.fine.shape[1], self.fine.shape[3]])
        corner[~is_fine] = np.column_stack([row, col, yaw]) * sides - [0, 0, sides[2] // 2]
        width[~is_fine] = sides
        at = corner + jitter * width
        yaw_rad = se2.wrap((at[:, 2] - 0.5) * se2.TWO_PI / self._fine_bins)
        return np.column_stack([self.fine_grid.xy_from_pixel(at[:, :2]), yaw_rad])

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest modes of the fine cells, with the moments of the mass around them.

        Where nothing is cut the one mode is the best coarse cell.
        """
        if k < 1:
            raise SkyfixError(f"modes: expected k > 0, got {k}")
        poses, masses, within = self._cells_by_mass()
        weights: list[float] = []
        means: list[FloatArray] = []
        covariances: list[FloatArray] = []
        free = np.ones(len(poses), np.bool_)
        while free.any() and len(means) < k:
            best = int(np.argmax(np.where(free, masses, -1.0)))
            offset = poses - poses[best]
            offset[:, 2] = se2.wrap(offset[:, 2])
            distance = np.maximum(
                np.hypot(offset[:, 0], offset[:, 1]) / _SEPARATION_M, np.abs(offset[:, 2]) / _SEPARATION_RAD
            )
            near = free & (distance <= _MODE_REACH)
            share = masses[near] / masses[near].sum()
            mean = share @ offset[near]
            residual = offset[near] - mean
            covariances.append((residual * share[:, None]).T @ residual + within)
            means.append(poses[best] + mean)
            weights.append(float(masses[near].sum()))
            free &= distance > _MODE_REACH
        ranked = np.argsort(weights)[::-1]
        share = np.array(weights)[ranked] / max(1.0, sum(weights))
        found = np.array(means)[ranked]
        found[:, 2] = se2.wrap(found[:, 2])
        return GaussianMixture(share, found, np.array(covariances)[ranked])

    def tempered(self, temperature: float) -> "TwoLevelLikelihood":
        """Divide the log densities by `temperature` and normalise again."""
        if checked_temperature(temperature) == 1.0:
            return self
        scale = np.float32(1.0 / temperature)
        return TwoLevelLikelihood.from_scores(self.coarse * scale, self.grid, self.cut, self.fine * scale, self.floor)

    def with_outliers(self, probability: float) -> OutlierMixture:
        """Allow for a measurement that says nothing: mix in the uniform density over the grid."""
        return OutlierMixture(self, probability)

    def around(self, centre: ArrayLike, half_extent_m: float) -> LikelihoodVolume:
        """The part within `half_extent_m` of a pose (3,), on fine cells and normalised by itself, all headings."""
        window = self.fine_grid.window(np.asarray(centre, np.float64)[:2], half_extent_m)
        row0, col0 = self.fine_grid.offset_of(window)
        row = np.clip(row0 + np.arange(window.rows), 0, self.fine_grid.rows - 1)
        col = np.clip(col0 + np.arange(window.cols), 0, self.fine_grid.cols - 1)
        index = np.meshgrid(row, col, np.arange(self._fine_bins), indexing="ij")
        values = self._at(*(each.reshape(-1) for each in index))
        return LikelihoodVolume.from_scores(values.reshape(window.rows, window.cols, -1), window)

    def peak(self) -> FloatArray:
        """The centre (3,) of the highest fine cell, or of the highest coarse one where nothing is cut."""
        poses, masses, _ = self._cells_by_mass()
        return poses[int(np.argmax(masses))]

    @property
    def _fine_bins(self) -> int:
        return self.coarse.shape[2] * self.fine.shape[3]

    def _log_mass(self) -> float:
        return _log_mass(self.coarse, self.grid, self.cut, self.fine)

    def _at(self, row: IntArray, col: IntArray, yaw_bin: IntArray) -> FloatArray:
        """Log densities (N,) of fine cells by their row, column and yaw bin."""
        side, turn = self.fine.shape[1], self.fine.shape[3]
        bins = self.coarse.shape[2]
        shifted = (yaw_bin + turn // 2) % self._fine_bins
        cell = ((row // side) * self.grid.cols + col // side) * bins + shifted // turn
        place = self._place[cell]
        value = self.coarse.reshape(-1)[cell].astype(np.float64)
        is_cut = place >= 0
        value[is_cut] = self.fine[place[is_cut], row[is_cut] % side, col[is_cut] % side, shifted[is_cut] % turn]
        return value

    def _fine_index(self, flat: IntArray) -> IntArray:
        """Row, column and yaw bin (N, 3) on the fine grid of places in `fine`, counted flat."""
        block, row, col, yaw = np.unravel_index(flat, self.fine.shape)
        sides = np.array([self.fine.shape[1], self.fine.shape[1], self.fine.shape[3]])
        return self.cut[block] * sides - [0, 0, sides[2] // 2] + np.column_stack([row, col, yaw])

    def _cells_by_mass(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Centres (N, 3) and masses (N,) of the fine cells that hold some, and the covariance (3, 3) inside one.

        Those of the best coarse cell where nothing is cut.
        """
        sides = np.array([self.fine.shape[1], self.fine.shape[1], self.fine.shape[3]])
        cell = np.array([*([self.fine_grid.metres_per_pixel] * 2), se2.TWO_PI / self._fine_bins])
        if len(self.fine):
            values = self.fine.reshape(-1)
            kept = np.flatnonzero(values > values.max() - _RANGE_NATS)
            index, mass = self._fine_index(kept), np.exp(values[kept].astype(np.float64)) * self.fine_volume
        else:
            best = int(np.argmax(self.coarse))
            corner = np.array(np.unravel_index(best, self.coarse.shape))[None] * sides
            index = corner + [sides[0] // 2, sides[1] // 2, 0]
            mass = np.exp(self.coarse.reshape(-1)[[best]].astype(np.float64)) * self.cell_volume
            cell = cell * sides
        xy = self.fine_grid.xy_from_pixel(index[:, :2] + 0.5)
        yaw = se2.wrap(index[:, 2] * se2.TWO_PI / self._fine_bins)
        return np.column_stack([xy, yaw]), mass, np.diag(cell**2 / 12.0)


def _cell_volume(grid: MapGrid, bins: int) -> float:
    return float(grid.metres_per_pixel**2 * se2.TWO_PI / bins)


def _log_mass(coarse: Float32Array, grid: MapGrid, cut: IntArray, fine: Float32Array) -> float:
    """ln of the integral of unnormalised log densities of both levels."""
    whole = np.ones(coarse.shape, np.bool_)
    whole[tuple(cut.T)] = False
    volume = _cell_volume(grid, coarse.shape[2])
    peak = max(float(coarse.max()), float(fine.max(initial=-np.inf)))
    mass = np.exp(coarse - np.float32(peak)).sum(where=whole, dtype=np.float64) * volume
    mass += np.exp(fine - np.float32(peak)).sum(dtype=np.float64) * volume / float(np.prod(fine.shape[1:]))
    return peak + float(np.log(mass))
