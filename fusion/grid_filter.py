"""The grid filter: the exact Bayes filter on cells of (heading, y, x), no particles and no Gaussians.

It is the reference that other filters are tested against, and a filter in its own right where the map is small or the
start unknown: it cannot lose a hypothesis. Prediction is `fusion.grids.grid_motion`, which keeps mean and covariance
exact. The measurement is evaluated at the centres of the cells, so likelihoods narrower than a cell need a finer grid.

Mass that leaves the map is not lost and never wraps around: it becomes the probability of being outside, whose
measurements are worth the density of the likelihood far away, and which `lost_score` reports. Mean, covariance and
modes are those of a vehicle that is on the map. With `kidnap_probability` the vehicle may be anywhere on the map at a
measurement, whatever was before; that is also the way back from outside.

Masses are float32, scaled such that they sum to 2^100, about 1e30. No cell falls below 1e-30, so that no pose is ever
ruled out for good, and far enough above the least float32 that no arithmetic with it is slow.

Sources: Burgard, Fox, Hennig, Schmidt, "Estimating the absolute position of a mobile robot using position probability
grids", AAAI 1996; Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, 8.2.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.grid import MapGrid
from fusion.grids.grid_kernels import reweigh
from fusion.grids.grid_lookup import look_up
from fusion.grids.grid_moments import grid_modes, grid_moments
from fusion.grids.grid_motion import GridMotion
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.scratch import Scratch
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement
from fusion.pose_filter import UpdateReport
from fusion.prior import UniformPrior

_WHOLE = 2.0**100
_LEAST = 1e-30
_LEAST_EVIDENCE = 1e-40


@dataclass(frozen=True, slots=True)
class GridFilterSettings:
    """How the filter behaves.

    Parameters
    ----------
    outlier_probability : float
        Chance that a measurement is about nothing, in (0, 1); bounds what one measurement can do.
    kidnap_probability : float
        Chance that the vehicle is anywhere on the map at a measurement, in [0, 1).

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    outlier_probability: float = 0.05
    kidnap_probability: float = 1e-3

    def __post_init__(self) -> None:
        if not 0.0 < self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in (0, 1), got {self.outlier_probability}")
        if not 0.0 <= self.kidnap_probability < 1.0:
            raise SkyfixError(f"kidnap_probability: expected in [0, 1), got {self.kidnap_probability}")


class GridFilter:
    """Probability mass on a lattice of poses.

    Parameters
    ----------
    mass : (K, rows, cols) array_like
        First distribution, non-negative, up to a factor; K headings from zero around the circle.
    grid : MapGrid
        Its raster: the map, in cells of any size.
    settings : GridFilterSettings
        How the filter behaves.
    outside : float
        Mass outside the map, in the same units.

    Raises
    ------
    SkyfixError
        When the shape is not the grid's, a value is negative or not finite, or there is no mass on the map.
    """

    def __init__(
        self, mass: ArrayLike, grid: MapGrid, settings: GridFilterSettings | None = None, outside: float = 0.0
    ) -> None:
        values = checked("mass", mass, ("K", grid.rows, grid.cols))
        total = float(values.sum())
        if values.size == 0 or values.min() < 0.0 or not total > 0.0:
            raise SkyfixError(f"mass: expected non-negative with a positive sum, got a sum of {total:g}")
        if not (np.isfinite(outside) and outside >= 0.0):
            raise SkyfixError(f"outside: expected a mass >= 0, got {outside}")
        total += outside
        self.settings = settings or GridFilterSettings()
        self._lattice = PoseLattice.of(grid, len(values))
        self._mass = np.maximum(values * (_WHOLE / total), _LEAST).astype(np.float32)
        self._spare = np.empty_like(self._mass)
        self._scratch = Scratch()
        self._outside = outside / total * _WHOLE
        self._total = _WHOLE  # of the mass and the outside together, in the units of the mass
        self._log_evidence = 0.0

    @classmethod
    def from_prior(
        cls, prior: UniformPrior, grid: MapGrid, headings: int, settings: GridFilterSettings | None = None
    ) -> Self:
        """A filter whose cells hold their share of a prior's box; what of it lies beyond the map is outside.

        Raises
        ------
        SkyfixError
            When the box does not touch the map, or there is no heading.
        """
        lattice = PoseLattice.of(grid, headings)
        x, y = grid.centres()
        box, half = prior.half_extent_m, prior.half_heading_rad
        by_col = _share(x - prior.centre[0], box, lattice.cell[0])
        by_row = _share(y - prior.centre[1], box, lattice.cell[1])
        turn = se2.wrap(lattice.headings - prior.centre[2])
        by_heading = sum(_share(turn + shift, half, lattice.cell[2]) for shift in (-se2.TWO_PI, 0.0, se2.TWO_PI))
        mass = np.asarray(by_heading)[:, None, None] * by_row[:, None] * by_col
        inside = float(mass.sum())
        if not inside > 0.0:
            raise SkyfixError(f"prior: expected a box that touches {grid}, got one around {prior.centre}")
        return cls(mass, grid, settings, max(0.0, 1.0 - inside) if inside < 1.0 - 1e-9 else 0.0)

    @classmethod
    def from_density(
        cls, density: PoseLikelihood, grid: MapGrid, headings: int, settings: GridFilterSettings | None = None
    ) -> Self:
        """A filter that starts from a density over poses, taken at the centres of the cells."""
        lattice = PoseLattice.of(grid, headings)
        found = look_up(density, lattice, np.empty(lattice.shape, dtype=np.float32), Scratch())
        return cls(found.weights, grid, settings)

    @property
    def lattice(self) -> PoseLattice:
        """Where the cells lie now."""
        return self._lattice

    @property
    def probabilities(self) -> Float32Array:
        """Probability of every cell, (K, rows, cols); with `outside_probability` they sum to 1."""
        return read_only(self._mass * np.float32(1.0 / self._total))

    @property
    def outside_probability(self) -> float:
        """Probability that the vehicle is not on the map."""
        return self._outside / self._total

    def predict(self, increment: OdometryIncrement) -> None:
        """Move the mass by the increment and spread it by its covariance.

        Raises
        ------
        SkyfixError
            When the increment is less certain than the map is wide, or than half a turn.
        """
        motion = GridMotion.on(self._lattice, increment)
        gain = _WHOLE / self._total
        left = motion.apply(self._mass, self._spare, self._scratch, gain, _LEAST)
        self._mass, self._spare = self._spare, self._mass
        self._outside = self._outside * gain + left
        self._total, self._lattice = _WHOLE, motion.after

    def update(self, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        """Multiply the mass by a likelihood at the centres of the cells.

        Parameters
        ----------
        likelihood : PoseLikelihood
            Not masked by a prior, not tempered, without outliers: both are done here.
        temperature : float
            Flattens the likelihood for errors shared with the previous measurement, see `fusion.consistency`.

        Raises
        ------
        SkyfixError
            When the likelihood gives NaN or an infinity, or rules everything out; the filter is then as it was before.
        """
        measurement = likelihood.tempered(temperature).with_outliers(self.settings.outlier_probability)
        found = look_up(measurement, self._lattice, self._spare, self._scratch)
        kidnapped = self.settings.kidnap_probability
        gain = (1.0 - kidnapped) * _WHOLE / self._total
        fresh = kidnapped * _WHOLE / self._mass.size
        inside, squares = reweigh(self._mass, self._spare, gain, fresh, _LEAST)
        outside = gain * self._outside * found.outside
        evidence = (inside + outside) / _WHOLE
        if not (np.isfinite(evidence) and evidence > _LEAST_EVIDENCE):
            raise SkyfixError("likelihood: expected one that allows for the prediction, got one that rules it out")
        self._mass, self._spare = self._spare, self._mass
        self._outside, self._total = outside, inside + outside
        self._log_evidence = float(np.log(evidence)) + found.log_scale
        return UpdateReport(self._log_evidence, inside**2 / squares, lost_score=self.outside_probability)

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """Summary of the mass on the map; with its `max_modes` heaviest modes when that is not 0."""
        moments = grid_moments(self._mass, self._lattice)
        modes = grid_modes(self._mass, self._lattice, max_modes) if max_modes else None
        return Estimate(
            stamp_ns,
            moments.pose,
            moments.covariance,
            modes,
            moments.effective_cells,
            self._log_evidence,
            self.outside_probability,
        )


def _share(offset: FloatArray, half: float, cell: float) -> FloatArray:
    """Share of the interval ``+- half`` that lies in each cell, given the offsets of their centres."""
    overlap = np.minimum(offset + 0.5 * cell, half) - np.maximum(offset - 0.5 * cell, -half)
    return np.maximum(overlap, 0.0) / (2.0 * half)
