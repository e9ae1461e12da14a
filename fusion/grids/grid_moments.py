"""Mean, covariance and modes of mass on a lattice of poses.

Cells count as points at their centres: sampled so, a density wider than a cell has its own mean and covariance, and
not those of a staircase. A mass narrower than that says nothing of where in its cell the pose is, so no eigenvalue of a
covariance, measured in cells, is given below 1/12, the variance inside a cell.
"""

from dataclasses import dataclass

import numpy as np

from fusion import se2
from fusion.arrays import Float32Array, FloatArray
from fusion.gaussian_mixture import GaussianMixture
from fusion.grids.grid_kernels import plane_moments
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.taps import Taps
from fusion.likelihood import LikelihoodVolume
from fusion.modes import find_modes

_INSIDE_A_CELL = 1.0 / 12.0
_FRAME = 2


@dataclass(frozen=True, slots=True, eq=False)
class GridMoments:
    """Summary of a mass.

    Parameters
    ----------
    pose : (3,) float64
        Mean ``[x, y, yaw]``, map frame, circular in yaw.
    covariance : (3, 3) float64
        On the axes of the map, positive definite.
    effective_cells : float
        Number of cells that an even spread would fill: ``(sum m)^2 / sum m^2``.
    """

    pose: FloatArray
    covariance: FloatArray
    effective_cells: float


def grid_moments(mass: Float32Array, lattice: PoseLattice) -> GridMoments:
    """Moments of a mass (K, rows, cols) of any scale."""
    sums = plane_moments(mass)
    total = sums[:, 0].sum()
    share = sums[:, 0] / total
    by_plane = sums[:, 1:6] / np.maximum(sums[:, :1], np.finfo(np.float64).tiny)
    middle = np.array([0.5 * lattice.grid.rows, 0.5 * lattice.grid.cols])
    xy = lattice.grid.xy_from_pixel(by_plane[:, :2] + middle + lattice.offsets)
    yaw = se2.circular_mean(lattice.headings, share)
    pose = np.append(share @ xy, yaw)
    residual = np.column_stack([xy - pose[:2], se2.wrap(lattice.headings - yaw)])
    covariance = (residual * share[:, None]).T @ residual
    row, col, row_row, row_col, col_col = by_plane.T
    cells = np.array([[col_col - col * col, row * col - row_col], [row * col - row_col, row_row - row * row]])
    covariance[:2, :2] += cells @ share * lattice.cell[0] ** 2
    return GridMoments(pose, _widened(covariance, lattice.cell), float(total**2 / sums[:, 6].sum()))


def _widened(covariance: FloatArray, cell: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance / np.outer(cell, cell))
    widened = (vectors * np.maximum(values, _INSIDE_A_CELL)) @ vectors.T * np.outer(cell, cell)
    return np.asarray(0.5 * (widened + widened.T))


def grid_modes(mass: Float32Array, lattice: PoseLattice, k: int) -> GaussianMixture:
    """The at most `k` highest modes of a mass (K, rows, cols), by :func:`fusion.modes.find_modes`.

    For this the planes are brought back onto the raster, which splits mass among cells and adds up to a quarter of a
    cell squared to the covariances of positions; the mass itself stays as it is.
    """
    planes = lattice.shape[0]
    framed = np.pad(mass, ((0, 0), (_FRAME, _FRAME), (_FRAME, _FRAME)))
    cells = np.floor(-lattice.offsets)
    parts = (-lattice.offsets - cells)[:, None]
    corners = np.indices((2, 2)).reshape(2, -1).T
    weights = np.where(corners, parts, 1.0 - parts).prod(axis=2).ravel()
    own = np.repeat(np.arange(planes), len(corners))
    around = (cells.astype(np.int64)[:, None] + corners).reshape(-1, 2)
    settled = np.empty_like(mass)
    Taps.of(own, own, around, weights, planes).apply(framed, settled, 1e-37)
    scores = np.log(settled.transpose(1, 2, 0))
    modes = find_modes(LikelihoodVolume.from_scores(scores, lattice.grid), k)
    turn = np.array([0.0, 0.0, lattice.turned])
    return GaussianMixture(modes.weights, modes.means + turn, modes.covariances)
