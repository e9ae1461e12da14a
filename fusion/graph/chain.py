"""Chain: the motions between the nodes of a graph as arrays, and the same motions between some of the nodes only."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numba
import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.odometry import OdometryIncrement


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """N - 1 motions between N nodes.

    Parameters
    ----------
    deltas : (N - 1, 3) float64
        Each in the body frame of the node where it begins.
    covariances : (N - 1, 3, 3) float64
        Of their coordinates.
    """

    deltas: FloatArray
    covariances: FloatArray

    @classmethod
    def of(cls, increments: Sequence[OdometryIncrement]) -> Self:
        """The motions of increments."""
        if not increments:
            return cls(np.empty((0, 3)), np.empty((0, 3, 3)))
        deltas = np.concatenate([increment.delta for increment in increments]).reshape(-1, 3)
        covariances = np.concatenate([increment.covariance for increment in increments]).reshape(-1, 3, 3)
        return cls(deltas, covariances)

    def between(self, nodes: IntArray) -> "Chain":
        """The motions between neighbours among `nodes` (M,), increasing: composed, covariances to first order."""
        if len(nodes) == len(self.deltas) + 1:
            return self
        deltas, covariances = np.zeros((len(nodes) - 1, 3)), np.zeros((len(nodes) - 1, 3, 3))
        _accumulate(self.deltas, self.covariances, nodes, deltas, covariances)
        deltas[:, 2] = se2.wrap(deltas[:, 2])
        return Chain(deltas, covariances)

    def filled(self, nodes: IntArray, poses: FloatArray) -> FloatArray:
        """Poses (N, 3) of all nodes from those (M, 3) of some, of which the first is node 0: carried on from each."""
        count = len(self.deltas) + 1
        found = np.empty((count, 3))
        if len(nodes) == count:
            found[nodes] = poses
            return found
        found[nodes] = poses
        known = np.zeros(count, dtype=np.bool_)
        known[nodes] = True
        _carry_on(self.deltas, known, found)
        found[:, 2] = se2.wrap(found[:, 2])
        return found


@numba.njit(cache=True, nogil=True)
def _accumulate(
    deltas: NDArray[np.float64],
    covariances: NDArray[np.float64],
    nodes: NDArray[np.int64],
    totals: NDArray[np.float64],
    spreads: NDArray[np.float64],
) -> None:
    """Compose the deltas from each node to the next, and their covariances, as `fusion.odometry.accumulate` does."""
    by_first, by_second = np.eye(3), np.eye(3)
    for m in range(len(nodes) - 1):
        total, spread = totals[m], spreads[m]
        for k in range(nodes[m], nodes[m + 1]):
            cos, sin = np.cos(total[2]), np.sin(total[2])
            x, y = cos * deltas[k, 0] - sin * deltas[k, 1], sin * deltas[k, 0] + cos * deltas[k, 1]
            by_first[0, 2], by_first[1, 2] = -y, x
            by_second[0, 0], by_second[0, 1], by_second[1, 0], by_second[1, 1] = cos, -sin, sin, cos
            spread[:] = by_first @ spread @ by_first.T + by_second @ covariances[k] @ by_second.T
            total[0] += x
            total[1] += y
            total[2] += deltas[k, 2]


@numba.njit(cache=True, nogil=True)
def _carry_on(deltas: NDArray[np.float64], known: NDArray[np.bool_], poses: NDArray[np.float64]) -> None:
    for k in range(1, len(known)):
        if not known[k]:
            cos, sin = np.cos(poses[k - 1, 2]), np.sin(poses[k - 1, 2])
            poses[k, 0] = poses[k - 1, 0] + cos * deltas[k - 1, 0] - sin * deltas[k - 1, 1]
            poses[k, 1] = poses[k - 1, 1] + sin * deltas[k - 1, 0] + cos * deltas[k - 1, 1]
            poses[k, 2] = poses[k - 1, 2] + deltas[k - 1, 2]
