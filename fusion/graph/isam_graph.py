"""IsamGraph: a graph of planar poses in GTSAM's ISAM2, whose factors have names, to be replaced by.

Source: Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert, "iSAM2: Incremental smoothing and mapping using the Bayes
tree", IJRR 2012.
"""

from collections.abc import Collection, Mapping, Sequence

import gtsam
import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.graph.covariances import positive_definite, turned

Name = tuple[str, int]

_RELINEARISED_BEYOND = 1e-3  # metres and radians


class IsamGraph:
    """Poses by keys and factors by names; after an update that fails it is as it was."""

    def __init__(self) -> None:
        self._isam = _empty()
        self._factors: dict[Name, gtsam.NonlinearFactor] = {}
        self._slots: dict[Name, int] = {}

    def update(
        self,
        factors: Mapping[Name, gtsam.NonlinearFactor],
        poses: Mapping[int, FloatArray] | None = None,
        without: Collection[Name] = (),
    ) -> None:
        """Take factors in, each in place of the one of its name; new poses (3,) too; take others out.

        Raises
        ------
        SkyfixError
            When the graph cannot be solved with them.
        """
        gone = [self._slots[name] for name in {*without, *factors} if name in self._slots]
        new = poses or {}
        try:
            result = self._isam.update(_graph(factors), _values(new), gone)
            touched = {key for factor in factors.values() for key in list(factor.keys())}
            if not np.isfinite(self.poses(touched)).all():
                raise RuntimeError("NaN or an infinity")
        except RuntimeError as error:
            self._rebuild(new)
            reason = str(error).strip().splitlines()[0]
            raise SkyfixError(f"incremental smoother: expected a solvable graph, got {reason}") from error
        for name in without:
            self._factors.pop(name, None)
            self._slots.pop(name, None)
        self._factors.update(factors)
        self._slots.update(zip(factors, list(result.getNewFactorsIndices()), strict=True))

    def poses(self, keys: Collection[int]) -> FloatArray:
        """Estimates (M, 3)."""
        found = [self._isam.calculateEstimatePose2(key) for key in keys]
        return np.array([[pose.x(), pose.y(), pose.theta()] for pose in found]).reshape(-1, 3)

    def covariances(self, keys: Sequence[int], poses: FloatArray) -> FloatArray:
        """Marginals (M, 3, 3) on the axes of the map; of estimates `poses`."""
        own = np.array([self._isam.marginalCovariance(key) for key in keys]).reshape(-1, 3, 3)
        return positive_definite(turned(own, poses[:, 2]))

    def _rebuild(self, without: Collection[int]) -> None:
        """From the factors there were, at the poses that they were linearised at."""
        values = self._isam.getLinearizationPoint()
        for key in without:
            if values.exists(key):
                values.erase(key)
        self._isam = _empty()
        result = self._isam.update(_graph(self._factors), values)
        self._slots = dict(zip(self._factors, list(result.getNewFactorsIndices()), strict=True))


def _empty() -> gtsam.ISAM2:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(_RELINEARISED_BEYOND)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return gtsam.ISAM2(params)


def _graph(factors: Mapping[Name, gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors.values():
        graph.push_back(factor)
    return graph


def _values(poses: Mapping[int, FloatArray]) -> gtsam.Values:
    values = gtsam.Values()
    for key, pose in poses.items():
        values.insert(key, gtsam.Pose2(*pose.tolist()))
    return values
