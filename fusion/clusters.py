"""Clusters of a cloud of poses: groups of particles with empty space between them.

Particles are binned into cells of position and heading; cells that touch, corners and the seam of the circle included,
belong together. The cost is that of sorting the cloud, whatever its shape and extent.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.gaussian_mixture import GaussianMixture

CELL_M = 2.0
_YAW_CELLS = 24  # 15 degrees each
CELL_RAD = se2.TWO_PI / _YAW_CELLS
_HALF_OF_THE_NEIGHBOURS = [offset for offset in product((-1, 0, 1), repeat=3) if offset > (0, 0, 0)]
VARIANCE_FLOOR = np.diag([1e-6, 1e-6, 1e-8])  # 1 mm and 0.1 mrad: keeps a collapsed cloud invertible


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """A partition of N poses into M clusters, with the moments of each.

    Parameters
    ----------
    labels : (N,) int64
        Cluster of each pose.
    weights : (M,) float64
        Share of the total weight.
    means : (M, 3) float64
        Weighted mean, circular in yaw.
    covariances : (M, 3, 3) float64
        Second moments about the mean; positive semidefinite, zero for a single pose.
    """

    labels: IntArray
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray

    def __len__(self) -> int:
        return len(self.weights)

    def residuals(self, poses: FloatArray) -> FloatArray:
        """Poses (N, 3) less their cluster's mean, yaw wrapped."""
        residual = poses - self.means[self.labels]
        residual[:, 2] = se2.wrap(residual[:, 2])
        return residual

    def mixture(self, k: int) -> GaussianMixture:
        """The `k` heaviest clusters as Gaussians, heaviest first."""
        chosen = np.argsort(-self.weights, kind="stable")[:k]
        chosen = chosen[self.weights[chosen] > 0.0]
        weights = self.weights[chosen] / max(1.0, self.weights[chosen].sum())
        return GaussianMixture(weights, self.means[chosen], self.covariances[chosen] + VARIANCE_FLOOR)


def _labels(poses: FloatArray) -> tuple[IntArray, int]:
    plane = np.floor((poses[:, :2] - poses[:, :2].min(axis=0)) / CELL_M).astype(np.int64) + 1
    stride = int(plane[:, 1].max()) + 2  # an empty column on either side: no neighbour is found across it
    turns = poses[:, 2] / se2.TWO_PI
    yaw = np.minimum(((turns - np.floor(turns)) * _YAW_CELLS).astype(np.int64), _YAW_CELLS - 1)
    cells, cell_of = np.unique((plane[:, 0] * stride + plane[:, 1]) * _YAW_CELLS + yaw, return_inverse=True)
    column, yaw = np.divmod(cells, _YAW_CELLS)
    links = []
    for dx, dy, dt in _HALF_OF_THE_NEIGHBOURS:
        wanted = (column + dx * stride + dy) * _YAW_CELLS + (yaw + dt) % _YAW_CELLS
        found = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
        hit = np.flatnonzero(cells[found] == wanted)
        links.append(np.stack([hit, found[hit]]))
    a, b = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(len(cells), len(cells)))
    count, label_of_cell = connected_components(graph, directed=False)
    return label_of_cell.astype(np.int64)[cell_of], int(count)


def find_clusters(poses: FloatArray, weights: FloatArray) -> Clusters:
    """Partition poses (N, 3) with non-negative weights (N,) that sum to 1; a weightless cluster gets equal weights."""
    labels, count = _labels(poses)

    def total(values: FloatArray) -> FloatArray:
        return np.bincount(labels, weights=values, minlength=count).astype(np.float64)

    mass = total(weights)
    share = np.where(mass[labels] > 0.0, weights, 1.0)
    scale = total(share)
    share = share / scale[labels]
    yaw = np.arctan2(total(share * np.sin(poses[:, 2])), total(share * np.cos(poses[:, 2])))
    means = np.column_stack([total(share * poses[:, 0]), total(share * poses[:, 1]), se2.wrap(yaw)])
    partition = Clusters(labels, mass, means, np.zeros((count, 3, 3)))
    residual = partition.residuals(poses)
    covariances = np.empty((count, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        covariances[:, i, j] = covariances[:, j, i] = total(share * residual[:, i] * residual[:, j])
    return Clusters(labels, mass, means, covariances)
