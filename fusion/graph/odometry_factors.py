"""Odometry factors that know of the odometry's own errors: its scale, its mounting, and how its heading drifts.

The motion between two poses, seen from the first, is what the odometry says up to noise,

    between(x_k, x_k+1) = z(c) + e,    z(c) = [ e^s R(m + b d / 2) t,  yaw + b d ],    d = |t|,

with the increment (t, yaw) and the calibration c = (s, m, b) of the stretch of road that it belongs to: ln scale,
mounting yaw (rad), heading bias (rad / m). Calibrations of neighbouring stretches differ by a random walk.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray

_UNIT = gtsam.noiseModel.Unit.Create(3)


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedOdometry:
    """The N - 1 increments of a chain and the stretches that they belong to.

    Parameters
    ----------
    deltas : (N - 1, 3) float64
        As the odometry tells them.
    root_informations : (N - 1, 3, 3) float64
        ``W`` with ``W^T W`` the inverse of the covariance of a delta.
    stretch : (N - 1,) int64
        Non-decreasing, from 0.
    huber_width : float
        Residuals longer than so many standard deviations count less, see Huber 1964; infinity for no robust loss.
    """

    deltas: FloatArray
    root_informations: FloatArray
    stretch: IntArray
    huber_width: float

    def _residuals(self, poses: FloatArray, calibrations: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Motions (N - 1, 3), expected motions (N - 1, 3), whitened residuals (N - 1, 3)."""
        moved = se2.between(poses[:-1], poses[1:])
        expected = calibrated(self.deltas, calibrations[self.stretch])
        off = moved - expected
        off[:, 2] = se2.wrap(off[:, 2])
        return moved, expected, np.einsum("nij,nj->ni", self.root_informations, off)

    def cost(self, poses: FloatArray, calibrations: FloatArray) -> float:
        """Minus the log density, up to a constant."""
        length = np.linalg.norm(self._residuals(poses, calibrations)[2], axis=1)
        width = np.minimum(self.huber_width, length)
        return float((width * (length - 0.5 * width)).sum())

    def linearised(self, poses: FloatArray, calibrations: FloatArray) -> tuple[FloatArray, ...]:
        """By pose k, pose k + 1 and calibration, and the right-hand side, of each factor; whitened."""
        moved, expected, white = self._residuals(poses, calibrations)
        length = np.linalg.norm(white, axis=1)
        weight = np.sqrt(np.minimum(1.0, self.huber_width / np.maximum(length, 1e-12)))
        root = weight[:, None, None] * self.root_informations
        first = np.tile(-np.eye(3), (len(moved), 1, 1))
        first[:, 0, 2], first[:, 1, 2] = moved[:, 1], -moved[:, 0]
        second = se2.rotation(moved[:, 2])
        by_calibration = -calibration_derivative(self.deltas, expected)
        return root @ first, root @ second, root @ by_calibration, -weight[:, None] * white


def calibrated(deltas: FloatArray, calibrations: FloatArray) -> FloatArray:
    """Motions (M, 3) that odometry deltas (M, 3) stand for, given the calibration (M, 3) of each."""
    log_scale, mount, bias = calibrations.T
    distance = np.hypot(deltas[:, 0], deltas[:, 1])
    turn = mount + 0.5 * bias * distance
    cos, sin, scale = np.cos(turn), np.sin(turn), np.exp(log_scale)
    x, y = scale * (cos * deltas[:, 0] - sin * deltas[:, 1]), scale * (sin * deltas[:, 0] + cos * deltas[:, 1])
    return np.column_stack([x, y, se2.wrap(deltas[:, 2] + bias * distance)])


def calibration_derivative(deltas: FloatArray, expected: FloatArray) -> FloatArray:
    """Derivative (M, 3, 3) of `calibrated`, whose result is `expected`, by the calibration."""
    distance = np.hypot(deltas[:, 0], deltas[:, 1])
    derivative = np.zeros((len(deltas), 3, 3))
    derivative[:, :2, 0] = expected[:, :2]
    derivative[:, 0, 1], derivative[:, 1, 1] = -expected[:, 1], expected[:, 0]
    derivative[:, :2, 2] = 0.5 * distance[:, None] * derivative[:, :2, 1]
    derivative[:, 2, 2] = distance
    return derivative
