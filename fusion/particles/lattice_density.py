"""A density from a weighted cloud, to be evaluated anywhere and drawn from exactly: a kernel estimate on a lattice.

Each particle's weight is shared among the eight nodes of its lattice cell (cloud in cell), and every node carries a
hat, a product of triangles as wide as two cells. So the estimate is piecewise trilinear, it integrates to 1, evaluating
it at M poses costs O(M log N), and a draw from it is a particle, one of its nodes by its share, and a triangular
offset. Headings are a closed lattice around the circle. It widens the cloud by a third of a cell squared on average.

Source: Scott, Sheather, "Kernel density estimation with binned data", 1985 (linear binning).
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.particles.clusters import find_clusters
from fusion.particles.regularisation import silverman_bandwidth
from fusion.resampling import effective_sample_size, systematic

_CORNERS = tuple(product((0, 1), repeat=3))
_LEAST_CELL = np.array([1e-3, 1e-3, 1e-4])
LEAST_LOG_DENSITY = -700.0
"""Where there is no node within reach."""


@dataclass(frozen=True, slots=True, eq=False)
class LatticeDensity:
    """Masses at the nodes of a lattice over (x, y, yaw).

    Parameters
    ----------
    poses, weights : (N, 3), (N,) float64
        The cloud; weights sum to 1.
    cell : (3,) float64
        Spacing of the nodes, metres and radians; that of yaw divides the circle.
    nodes : (M,) int64
        Numbers of the occupied nodes, sorted.
    masses : (M,) float64
        Their masses; sum to 1.
    origin, rows, turns
        How nodes are numbered.
    """

    poses: FloatArray
    weights: FloatArray
    cell: FloatArray
    nodes: IntArray
    masses: FloatArray
    origin: FloatArray
    rows: int
    turns: int

    @classmethod
    def of(cls, poses: FloatArray, log_weights: FloatArray, scale: float = 0.5) -> "LatticeDensity":
        """Estimate from poses (N, 3) and normalised log weights (N,), `scale` times Silverman's bandwidth wide."""
        weights = np.exp(log_weights)
        weights /= weights.sum()
        clusters = find_clusters(poses, weights)
        within = np.einsum("m,mii->i", clusters.weights, clusters.covariances)
        size = max(effective_sample_size(log_weights) / max((clusters.weights**2).sum() ** -1.0, 1.0), 2.0)
        cell = np.maximum(np.sqrt(3.0 * within) * scale * silverman_bandwidth(size, 3), _LEAST_CELL)
        turns = max(int(se2.TWO_PI / cell[2]), 3)
        cell[2] = se2.TWO_PI / turns
        origin = np.array([poses[:, 0].min() - cell[0], poses[:, 1].min() - cell[1], -np.pi])
        rows = int((poses[:, 1].max() - origin[1]) / cell[1]) + 4
        empty = cls(poses, weights, cell, np.zeros(0, np.int64), np.zeros(0), origin, rows, turns)
        numbers, shares = zip(*empty._corners(poses), strict=True)
        nodes, place = np.unique(np.concatenate(numbers), return_inverse=True)
        masses = np.zeros(len(nodes))
        np.add.at(masses, place, np.concatenate(shares) * np.tile(weights, 8))
        return cls(poses, weights, cell, nodes, masses, origin, rows, turns)

    def log_density(self, poses: FloatArray) -> FloatArray:
        """ln density (N,) per m^2 rad at poses (N, 3), at least -700."""
        density = np.zeros(len(poses))
        for number, share in self._corners(poses):
            place = np.minimum(np.searchsorted(self.nodes, number), len(self.nodes) - 1)
            density += np.where(self.nodes[place] == number, share * self.masses[place], 0.0)
        density /= self.cell.prod()
        return np.log(np.maximum(density, np.exp(LEAST_LOG_DENSITY)))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3) from the density itself."""
        at = (self.poses[systematic(self.weights, n, rng)] - self.origin) / self.cell
        node = np.floor(at)
        node += rng.random((n, 3)) < at - node
        drawn = self.origin + (node + rng.random((n, 3)) + rng.random((n, 3)) - 1.0) * self.cell
        drawn[:, 2] = se2.wrap(drawn[:, 2])
        return drawn

    def _corners(self, poses: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """Numbers and shares of the eight nodes around each pose; those off the lattice get number -1."""
        at = (poses - self.origin) / self.cell
        lower = np.floor(at).astype(np.int64)
        fraction = at - lower
        result = []
        for corner in _CORNERS:
            node = lower + corner
            share = np.where(corner, fraction, 1.0 - fraction).prod(axis=1)
            on = (node[:, 0] >= 0) & (node[:, 1] >= 0) & (node[:, 1] < self.rows)
            number = (node[:, 0] * self.rows + node[:, 1]) * self.turns + node[:, 2] % self.turns
            result.append((np.where(on, number, -1), share))
        return result
