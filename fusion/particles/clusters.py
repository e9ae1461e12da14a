"""Clusters of a cloud of poses: groups of particles with empty space between them.

Particles are binned into cells of position and heading; cells that touch, corners and the seam of the circle included,
belong together. The cost is linear in the particles and, up to a limit, in the cells that the cloud spans; beyond it
the cost is that of sorting the cloud.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.gaussian_mixture import GaussianMixture
from fusion.kernels.cloud_clusters import cells_of_cloud, extent
from fusion.kernels.clusters import cells_of, components, moments_of

CELL_M = 2.0
_YAW_CELLS = 24  # 15 degrees each
_MOST_CELLS = 2**24
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
    x0, y0 = poses[:, 0].min(), poses[:, 1].min()
    rows = int((poses[:, 0].max() - x0) / CELL_M) + 3  # an empty row and column on either side
    cols = int((poses[:, 1].max() - y0) / CELL_M) + 3
    cells, size = cells_of(poses, x0, y0, CELL_M, cols, _YAW_CELLS), rows * cols * _YAW_CELLS
    if size <= _MOST_CELLS:
        return components(cells, size, cols, _YAW_CELLS)
    return _sparse_components(cells, cols)


def cloud_labels(cloud: Float32Array) -> tuple[NDArray[np.int32], int]:
    """Cluster (N,) of each particle of a cloud as the compiled step keeps it (3 N,), and their number."""
    count = len(cloud) // 3
    (x0, x1), (y0, y1) = extent(cloud[:count]), extent(cloud[count : 2 * count])
    rows, cols = int((x1 - x0) / CELL_M) + 3, int((y1 - y0) / CELL_M) + 3
    size = rows * cols * _YAW_CELLS
    if size <= _MOST_CELLS:
        return components(cells_of_cloud(cloud, x0, y0, CELL_M, cols, _YAW_CELLS), size, cols, _YAW_CELLS)
    labels, clusters = _labels(np.ascontiguousarray(cloud.reshape(3, -1).T, dtype=np.float64))
    return labels.astype(np.int32), clusters


def _sparse_components(cell_of: IntArray, cols: int) -> tuple[IntArray, int]:
    """Labels (N,) and their number by sorting the cells, for a cloud so wide that its grid would not fit."""
    cells, place_of = np.unique(cell_of, return_inverse=True)
    column, yaw = np.divmod(cells, _YAW_CELLS)
    links = []
    for dx, dy, dt in _HALF_OF_THE_NEIGHBOURS:
        wanted = (column + dx * cols + dy) * _YAW_CELLS + (yaw + dt) % _YAW_CELLS
        found = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
        hit = np.flatnonzero(cells[found] == wanted)
        links.append(np.stack([hit, found[hit]]))
    a, b = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(len(cells), len(cells)))
    count, label_of_cell = connected_components(graph, directed=False)
    return label_of_cell.astype(np.int64)[place_of], int(count)


def find_clusters(poses: FloatArray, weights: FloatArray) -> Clusters:
    """Partition poses (N, 3) with non-negative weights (N,) that sum to 1; clusters below 1e-300 get equal ones."""
    poses, weights = np.ascontiguousarray(poses), np.ascontiguousarray(weights)
    labels, count = _labels(poses)
    return Clusters(labels, *moments_of(poses, weights, labels, count))
