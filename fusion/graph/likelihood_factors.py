"""Whole likelihoods for a graph of your own in GTSAM, on Pose2 or Pose3 keys.

    likelihoods = LikelihoodFactors(keys, measurements)
    for _ in range(4):
        graph = gtsam.NonlinearFactorGraph(mine)
        for factor in likelihoods.at(values, covariances):
            graph.push_back(factor)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        marginals = gtsam.Marginals(graph, values)
        covariances = [marginals.marginalCovariance(key) for key in keys]

Each is the Gaussian that has the likelihood's effect under the present marginal of its pose, as a native factor: no
callback into Python, whichever optimizer (or ISAM2) it goes to. Two to four rounds are enough.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from fusion.arrays import FloatArray, checked
from fusion.errors import SkyfixError
from fusion.graph.covariances import positive_definite, turned
from fusion.graph.measurements import Measurement, Measurements
from fusion.graph.sites import Sites

_PLANAR = np.array([3, 4, 2])  # of Pose3's tangent (roll, pitch, yaw, forward, left, up): forward, left, yaw


class LikelihoodFactors:
    """The likelihoods of some poses of a graph, and the factors that stand for them at present.

    Parameters
    ----------
    keys : sequence of int
        M keys of Pose2 or Pose3 variables. A Pose3 is seen from above: its x, y and yaw.
    measurements : sequence of M Measurement
        Tempered for errors that are correlated in time.
    outlier_probability : float
        Chance that a measurement says nothing, in [0, 1); one of its own, by `with_outliers`, counts beside it.
    clutter_log_density : float
        ln density per m^2 rad of such a measurement where it does not tell itself (mixtures of modes).

    Raises
    ------
    SkyfixError
        When the counts disagree, or the probability is out of range.
    """

    def __init__(
        self,
        keys: Sequence[int],
        measurements: Sequence[Measurement],
        outlier_probability: float = 0.05,
        clutter_log_density: float = -9.2,
    ) -> None:
        if len(keys) != len(measurements):
            raise SkyfixError(f"likelihoods: expected one measurement a key, got {len(measurements)} and {len(keys)}")
        if not 0.0 <= outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in [0, 1), got {outlier_probability}")
        seen = Measurements(measurements, outlier_probability, clutter_log_density)
        self._keys = [keys[place] for place in seen.nodes.tolist()]
        self._seen = seen
        self._sites: Sites | None = None

    def at(self, values: gtsam.Values, covariances: Sequence[FloatArray]) -> list[gtsam.NonlinearFactor]:
        """The factors for the next round.

        Parameters
        ----------
        values : gtsam.Values
            The present estimate.
        covariances : sequence of M arrays
            What GTSAM's marginals say of the keys, in the order in which they were given: (3, 3) of a Pose2, (6, 6) of
            a Pose3, with the factors of the round before in the graph. Before the first round, how far the start can
            be trusted.

        Raises
        ------
        SkyfixError
            When a covariance has another shape or is not positive definite.
        """
        poses = np.array([_planar(values, key) for key in self._keys]).reshape(-1, 3)
        given = [covariances[place] for place in self._seen.nodes.tolist()]
        own = np.array([_planar_covariance(covariance) for covariance in given]).reshape(-1, 3, 3)
        spread = positive_definite(turned(own, poses[:, 2]))
        centres = poses
        if self._sites is not None:
            centres, spread = self._sites.cavities(poses, spread)
        found, _ = self._seen.windowed(centres, spread)
        self._sites = Sites(centres, *found.factors()).about(poses)
        precision, information = self._sites.on_body_axes()
        return [
            _factor(values, key, matrix, vector)
            for key, matrix, vector in zip(self._keys, precision, information, strict=True)
        ]


def _is_spatial(values: gtsam.Values, key: int) -> bool:
    try:
        values.atPose3(key)
    except RuntimeError:
        return False
    return True


def _planar(values: gtsam.Values, key: int) -> list[float]:
    if _is_spatial(values, key):
        pose = values.atPose3(key)
        return [pose.x(), pose.y(), pose.rotation().yaw()]
    flat = values.atPose2(key)
    return [flat.x(), flat.y(), flat.theta()]


def _planar_covariance(covariance: FloatArray) -> FloatArray:
    covariance = checked("covariance", covariance, ("D", "D"))
    if covariance.shape == (6, 6):
        return covariance[np.ix_(_PLANAR, _PLANAR)]
    return checked("covariance", covariance, (3, 3))


def _factor(values: gtsam.Values, key: int, precision: FloatArray, information: FloatArray) -> gtsam.NonlinearFactor:
    """A quadratic around the present pose as a factor that GTSAM re-linearises by itself."""
    at = gtsam.Values()
    if _is_spatial(values, key):
        at.insert(key, values.atPose3(key))
        whole, along = np.zeros((6, 6)), np.zeros(6)
        whole[np.ix_(_PLANAR, _PLANAR)], along[_PLANAR] = precision, information
        return gtsam.LinearContainerFactor(gtsam.HessianFactor(key, whole, along, 0.0), at)
    at.insert(key, values.atPose2(key))
    return gtsam.LinearContainerFactor(gtsam.HessianFactor(key, precision, information, 0.0), at)
