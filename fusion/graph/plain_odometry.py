"""PlainOdometry: motions along a chain of poses taken as they come, GTSAM's factors linearised in one compiled pass.

The residual is ``log(z^-1 h(x))`` with Huber's loss, GTSAM's `BetweenFactorPose2`. A prior is a motion from the origin.
"""

from dataclasses import dataclass
from typing import Self

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray, IntArray
from fusion.graph.chain_algebra import OPTIONS, invert
from fusion.graph.chain_steps import motion_error
from fusion.graph.covariances import positive_definite, turned
from fusion.graph.inverses import inverses

_NO_SIGMAS = np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class PlainOdometry:
    """M motions, each from a pose to the next; without calibrations.

    Parameters
    ----------
    deltas : (M, 3) float64
        Each in the body frame of the pose where it begins.
    roots : (M, 3, 3) float64
        ``W`` with ``W^T W`` the inverse of the covariance of a residual, on the axes of the body where it ends.
    huber_width : float
        Residuals longer than so many standard deviations count less; infinity for no robust loss.
    """

    deltas: FloatArray
    roots: FloatArray
    huber_width: float

    @classmethod
    def of(cls, deltas: FloatArray, covariances: FloatArray, huber_width: float) -> Self:
        """Motions whose coordinates have covariances (M, 3, 3), on the axes of the body where they begin."""
        own = positive_definite(turned(covariances, -deltas[:, 2]))
        return cls(deltas, inverses(np.asarray(np.linalg.cholesky(own), dtype=np.float64)), huber_width)

    @property
    def count(self) -> int:
        """Number of calibrations."""
        return 0

    @property
    def stretch(self) -> IntArray:
        """Which calibration each motion has (M,): none."""
        return np.zeros(len(self.deltas), dtype=np.int64)

    @property
    def first_sigmas(self) -> FloatArray:
        """Of the first calibration: none."""
        return _NO_SIGMAS

    @property
    def step_sigmas(self) -> FloatArray:
        """Of the steps between calibrations: none."""
        return _NO_SIGMAS

    def cost(self, poses: FloatArray, calibrations: FloatArray) -> float:
        """Minus the log density at poses (M + 1, 3), up to a constant."""
        return float(_cost(poses, self.deltas, self.roots, self.huber_width))

    def linearised(self, poses: FloatArray, calibrations: FloatArray) -> tuple[FloatArray, ...]:
        """Derivatives by the first pose, the second and the calibration, and the right-hand sides; whitened.

        Deviations of poses are on the axes of the map.
        """
        count = len(self.deltas)
        first, second, right = np.empty((count, 3, 3)), np.empty((count, 3, 3)), np.empty((count, 3))
        _linearise(poses, self.deltas, self.roots, self.huber_width, first, second, right)
        return first, second, np.empty((count, 3, 0)), right


@numba.njit(**OPTIONS)
def _cost(
    poses: NDArray[np.float64], deltas: NDArray[np.float64], roots: NDArray[np.float64], huber_width: float
) -> float:
    residual, inverse, total = np.empty(3), np.empty((3, 3)), 0.0
    for k in range(len(deltas)):
        motion_error(poses[k], poses[k + 1], deltas[k], residual, inverse)
        square = 0.0
        for i in range(3):
            white = roots[k, i, 0] * residual[0] + roots[k, i, 1] * residual[1] + roots[k, i, 2] * residual[2]
            square += white * white
        length = np.sqrt(square)
        width = min(huber_width, length)
        total += width * (length - 0.5 * width)
    return total


@numba.njit(**OPTIONS)
def _linearise(
    poses: NDArray[np.float64],
    deltas: NDArray[np.float64],
    roots: NDArray[np.float64],
    huber_width: float,
    firsts: NDArray[np.float64],
    seconds: NDArray[np.float64],
    rights: NDArray[np.float64],
) -> None:
    residual, inverse, derivative, white = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(len(deltas)):
        motion_error(poses[k], poses[k + 1], deltas[k], residual, inverse)
        invert(inverse, derivative)
        root = roots[k]
        square = 0.0
        for i in range(3):
            white[i] = root[i, 0] * residual[0] + root[i, 1] * residual[1] + root[i, 2] * residual[2]
            square += white[i] * white[i]
        weight = np.sqrt(min(1.0, huber_width / max(np.sqrt(square), 1e-12)))
        x, y = poses[k, 1] - poses[k + 1, 1], poses[k + 1, 0] - poses[k, 0]  # of the second, by the first's heading
        for i in range(3):
            for j in range(3):
                total = root[i, 0] * derivative[0, j] + root[i, 1] * derivative[1, j] + root[i, 2] * derivative[2, j]
                seconds[k, i, j] = weight * total
                firsts[k, i, j] = -weight * total
            firsts[k, i, 2] -= seconds[k, i, 0] * x + seconds[k, i, 1] * y
            rights[k, i] = -weight * white[i]
