"""GridNoise: Gaussian noise of the pose as shares that cells give to each other.

A heading error is a whole number of planes, with the probabilities of a discrete Gaussian. Given it, the position errs
by its conditional mean ``Q_pt / Q_tt e``, which is how a heading error during the motion carries it sideways, and by
its conditional covariance ``S = Q_pp - Q_pt Q_tp / Q_tt``. Planes lie at parts of a cell from each other, so the mean
is hardly ever whole.

- S of at least 0.3 cells squared along its narrowest axis: a discrete Gaussian with just this mean and covariance
  (`fusion.grids.discrete_gaussian`) for every pair of planes. Where S is wide, most of it is taken out beforehand, by
  blurs of the planes along lines of cells: two of at least 0.7 cells squared each make the Gaussian of both.
- Narrower S: blurs along lines for every plane, and a linear split between four cells for heading errors, whose
  variance ``f (1 - f)`` is taken out of the blurs.

A blur with any 2 x 2 covariance is three blurs along lines of cells. Selling's formula writes a positive definite D as
a sum of three ``weight * v v^T`` with whole vectors v and weights >= 0, so that no mass is ever split between cells.

Sources: Selling, "Ueber die binaeren und ternaeren quadratischen Formen", 1874; Fehrenbach, Mirebeau, "Sparse
non-negative stencils for anisotropic diffusion", 2014, section 1 (the formula in this use). The factorisation is that
of a Gaussian into a marginal and a conditional.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.grids.discrete_gaussian import LEAST_PLANAR_VARIANCE, planar_gaussians, symmetric_taps
from fusion.grids.grid_kernels import DIRECTIONS, selling
from fusion.grids.taps import Ways

_LEAST_VARIANCE = 1e-12  # cells squared; less is none
_LEAST_ASPECT = 1.0 / 256.0  # of the variances across and along
_LEAST_SHARE = 1e-5  # of a plane's mass that may be cut off for each heading error
_LEAST_DENSITY = 1e-3  # of the peak, up to which that may go
_KEPT_VARIANCE = 0.7  # cells squared that stay when a line blurs; it takes at least as much

Lines = tuple[IntArray, Float32Array, IntArray]
"""Directions (K, 3, 2), taps (K, 3, R + 1) and radii (K, 3) of the blurs, as `grid_kernels.translate` takes them."""


@dataclass(frozen=True, slots=True, eq=False)
class GridNoise:
    """Blurs of the planes along lines, then ways between cells.

    Parameters
    ----------
    lines : Lines
        The three blurs of every plane.
    ways : Ways
        Shares for the cells around, of the plane itself and of others.
    """

    lines: Lines
    ways: Ways

    @classmethod
    def of(cls, covariances: FloatArray, offsets: FloatArray) -> Self:
        """Noise of covariances (K, 3, 3) of (row, col, plane), where planes lie at `offsets` (K, 2) cells."""
        planes, heading = len(offsets), float(covariances[:, 2, 2].mean())
        spread, carried = covariances[:, :2, :2], np.zeros((planes, 2))
        half = np.ones(1, dtype=np.float32)
        if heading > _LEAST_VARIANCE:
            carried = covariances[:, :2, 2] / heading
            spread = spread - heading * carried[:, :, None] * carried[:, None]
            half = symmetric_taps(np.array([heading]))[0]
        half = half[: int(np.flatnonzero(half).max()) + 1]
        jumps = np.arange(1 - len(half), len(half))
        shares = half[np.abs(jumps)].astype(np.float64)
        targets = (np.arange(planes)[:, None] + jumps) % planes
        means = offsets[:, None] - offsets[targets] + carried[:, None] * jumps[:, None]
        if np.linalg.eigvalsh(spread)[:, 0].min() >= LEAST_PLANAR_VARIANCE:
            return cls._dense(spread, targets, means, shares)
        return cls._split(spread, targets, means, shares)

    @classmethod
    def _dense(cls, spread: FloatArray, targets: IntArray, means: FloatArray, shares: FloatArray) -> Self:
        directions, variances = _lines(spread)
        taken = np.where(variances >= 2.0 * _KEPT_VARIANCE, variances - _KEPT_VARIANCE, 0.0)
        kept = spread - np.einsum("kd,kdi,kdj->kij", taken, directions, directions)
        unkept = np.linalg.eigvalsh(kept)[:, 0] < LEAST_PLANAR_VARIANCE
        taken[unkept], kept[unkept] = 0.0, spread[unkept]
        planes = len(targets)
        extent = 2.0 * np.sqrt(-2.0 * np.log(_LEAST_SHARE) * kept[:, [0, 1], [0, 1]].max(axis=0)) + 2.0
        least = np.minimum(_LEAST_SHARE / shares, _LEAST_DENSITY)
        sizes, cells, weights = planar_gaussians(means, kept, least, int(np.prod(np.ceil(extent))))
        used = np.arange(weights.shape[2]) < sizes[:, :, None]
        sources = np.broadcast_to(np.arange(planes)[:, None, None], used.shape)[used]
        reached = np.broadcast_to(targets[:, :, None], used.shape)[used]
        weighed = weights[used] * np.broadcast_to(shares[:, None], used.shape)[used]  # the unused are not set
        ways = Ways(sources, reached, cells[used], weighed, planes)
        return cls(_with_taps(directions, taken), ways)

    @classmethod
    def _split(cls, spread: FloatArray, targets: IntArray, means: FloatArray, shares: FloatArray) -> Self:
        planes, count = targets.shape
        middle = count // 2
        low = np.floor(means)
        parts = means - low
        low[:, middle], parts[:, middle] = 0.0, 0.0
        excess = np.einsum("m,kmi->ki", shares, parts * (1.0 - parts))
        corners = np.indices((2, 2)).reshape(2, -1).T
        weights = np.where(corners, parts[:, :, None], 1.0 - parts[:, :, None]).prod(axis=3) * shares[:, None]
        cells = low.astype(np.int64)[:, :, None] + corners
        used = weights > 0.0
        sources = np.broadcast_to(np.arange(planes)[:, None, None], used.shape)
        reached = np.broadcast_to(targets[:, :, None], used.shape)
        ways = Ways(sources[used], reached[used], cells[used], weights[used], planes)
        return cls(_with_taps(*_lines(_less(spread, excess))), ways)


def _with_taps(directions: IntArray, variances: FloatArray) -> Lines:
    taps = symmetric_taps(variances.ravel()).reshape(*variances.shape, -1)
    return directions, taps, (taps > 0.0).sum(axis=2) - 1


def _less(spread: FloatArray, excess: FloatArray) -> FloatArray:
    """Covariances (K, 2, 2) less the diagonal `excess` (K, 2), or as much of it as leaves them semidefinite."""
    trace = np.trace(spread, axis1=1, axis2=2)[:, None, None]
    solid = spread + (_LEAST_VARIANCE + _LEAST_ASPECT * trace) * np.eye(2)
    ratio = np.linalg.eigvals(np.linalg.solve(solid, excess[:, :, None] * np.eye(2))).real.max(axis=1)
    share = np.minimum(1.0, (1.0 - _LEAST_ASPECT) / np.maximum(ratio, 1e-300))
    return np.asarray(spread - (share[:, None] * excess)[:, :, None] * np.eye(2))


def _lines(spread: FloatArray) -> tuple[IntArray, FloatArray]:
    """Directions (K, 3, 2) and variances (K, 3), zero where negligible, whose sum is each covariance (K, 2, 2)."""
    values, vectors = np.linalg.eigh(spread)
    values = np.maximum(values, np.maximum(_LEAST_ASPECT * values[:, 1:], _LEAST_VARIANCE))
    solid = np.einsum("kij,kj,klj->kil", vectors, values, vectors)
    directions = np.empty((len(spread), DIRECTIONS, 2), dtype=np.int64)
    variances = np.empty((len(spread), DIRECTIONS))
    selling(np.ascontiguousarray(solid), directions, variances)
    return directions, np.where(variances > 2.0 * _LEAST_VARIANCE, variances, 0.0)
