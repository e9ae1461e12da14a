"""Regularisation: give the copies that resampling makes a life of their own, without widening the cloud.

Each particle is drawn towards the mean of its cluster and gets kernel noise with the cluster's covariance,

    x' = m + sqrt(1 - h^2) (x - m) + h L e,        L L^T = covariance,  e ~ N(0, I)

which leaves mean and covariance of every cluster as they are. The bandwidth is Silverman's, times a scale.

Source: Liu, West, "Combined parameter and state estimation in simulation-based filtering", 2001, section 10.2.3;
Silverman, "Density estimation for statistics and data analysis", 1986, equation 4.14.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import Float32Array, FloatArray
from fusion.kernels.cloud_clusters import cloud_moments, cluster_rows
from fusion.kernels.clusters import spread_in_clusters
from fusion.particles.clusters import CELL_M, CELL_RAD, cloud_labels, find_clusters

FloatOrArray = TypeVar("FloatOrArray", float, FloatArray)


def matrix_root(covariance: FloatArray) -> FloatArray:
    """A matrix R (..., 3, 3) with ``R R^T = covariance``; semidefinite matrices are welcome."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def silverman_bandwidth(count: FloatOrArray, dimensions: int) -> FloatOrArray:
    """Kernel width, in standard deviations, for a Gaussian sample of `count` points."""
    return (4.0 / (count * (dimensions + 2.0))) ** (1.0 / (dimensions + 4.0))


def is_compact(covariance: list[list[float]]) -> bool:
    """Whether a cloud is narrow enough to be one cluster: spread less than a cell of `fusion.particles.clusters`."""
    return max(covariance[0][0], covariance[1][1]) < CELL_M**2 and covariance[2][2] < CELL_RAD**2


def regularised(particles: FloatArray, scale: float, rng: np.random.Generator) -> FloatArray:
    """Equally weighted particles (N, 3) with kernel noise of `scale` times Silverman's bandwidth, 0 <= scale <= 1."""
    if scale == 0.0:
        return particles
    clusters = find_clusters(particles, np.full(len(particles), 1.0 / len(particles)))
    count = np.bincount(clusters.labels).astype(np.float64)
    widths = scale * silverman_bandwidth(count, 3)
    roots = matrix_root(clusters.covariances)
    key = rng.integers(2**32, size=4, dtype=np.uint32)
    particles = np.ascontiguousarray(particles)
    return spread_in_clusters(particles, clusters.labels, clusters.means, roots, widths, key)


def cluster_kernels(cloud: Float32Array, scale: float) -> tuple[NDArray[np.int32], Float32Array] | None:
    """The kernels of a cloud as the compiled step keeps it, see `fusion.kernels.cloud_clusters`.

    Parameters
    ----------
    cloud : (3 N,) float32
        x, y and yaw of equally weighted particles.
    scale : float
        Of Silverman's bandwidth, 0 < scale <= 1.

    Returns
    -------
    Cluster (N,) of each particle and the clusters' rows for the step; None when all particles are one cluster.
    """
    labels, clusters = cloud_labels(cloud)
    if clusters == 1:
        return None
    number, means, squares = cloud_moments(cloud, labels, clusters)
    return labels, cluster_rows(means, squares, scale * silverman_bandwidth(number, 3))
