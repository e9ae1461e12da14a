"""CalibrationWalk: an odometry in a graph together with its calibrations, one a stretch of road."""

from dataclasses import dataclass

import gtsam
import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.graph.odometry_factors import CalibratedOdometry

_UNIT = gtsam.noiseModel.Unit.Create(3)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationWalk:
    """Odometry factors between N poses, and S calibrations that differ from one stretch to the next.

    Parameters
    ----------
    odometry : CalibratedOdometry
        Its stretches are 0 to S - 1.
    first_sigmas : (3,) float64
        Standard deviations of the first calibration about zero: of ln scale, mounting (rad), heading bias (rad / m).
    step_sigmas : (3,) float64
        Of the difference between neighbouring stretches.
    """

    odometry: CalibratedOdometry
    first_sigmas: FloatArray
    step_sigmas: FloatArray

    @property
    def count(self) -> int:
        """Number S of stretches."""
        return int(self.odometry.stretch[-1]) + 1

    @property
    def stretch(self) -> IntArray:
        """The calibration of each motion (N - 1,), non-decreasing."""
        return self.odometry.stretch

    @property
    def _poses(self) -> int:
        return len(self.odometry.deltas) + 1

    def elimination_order(self) -> IntArray:
        """Keys (N + S,): poses in order, each calibration after the last pose that its stretch begins at."""
        stretch, count = self.odometry.stretch, self._poses
        last = np.append(np.flatnonzero(np.diff(stretch)), count - 2)
        return np.insert(np.arange(count), last + 1, count + np.arange(self.count))

    def cost(self, poses: FloatArray, calibrations: FloatArray) -> float:
        """Minus the log density of the odometry and the calibrations, up to a constant."""
        first = calibrations[0] / self.first_sigmas
        steps = np.diff(calibrations, axis=0) / self.step_sigmas
        return self.odometry.cost(poses, calibrations) + 0.5 * float((first**2).sum() + (steps**2).sum())

    def linearised(self, poses: FloatArray, calibrations: FloatArray) -> tuple[FloatArray, ...]:
        """As `CalibratedOdometry.linearised`, poses on the axes of the map."""
        first, second, own, right = self.odometry.linearised(poses, calibrations)
        back = se2.rotation(-poses[:, 2])
        return first @ back[:-1], second @ back[1:], own, right

    def add_to(self, linear: gtsam.GaussianFactorGraph, poses: FloatArray, calibrations: FloatArray) -> None:
        """Add all factors, linearised; poses in GTSAM's body-frame tangent vectors."""
        key = self._poses
        terms = self.odometry.linearised(poses, calibrations)
        for node, (stretch, first, second, own, right) in enumerate(
            zip(self.odometry.stretch.tolist(), *terms, strict=True)
        ):
            factor = gtsam.JacobianFactor(node, first, node + 1, second, key + stretch, own, right, _UNIT)
            linear.push_back(factor)
        weight = np.diag(1.0 / self.first_sigmas)
        linear.push_back(gtsam.JacobianFactor(key, weight, -weight @ calibrations[0], _UNIT))
        weight = np.diag(1.0 / self.step_sigmas)
        for stretch, step in enumerate(np.diff(calibrations, axis=0)):
            own = key + stretch
            linear.push_back(gtsam.JacobianFactor(own, -weight, own + 1, weight, -weight @ step, _UNIT))
