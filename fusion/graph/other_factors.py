"""What else may bind the poses of a drive: places seen again, absolute positions (GNSS); each with a robust loss.

The losses let go of what does not fit, so they are wide at first and narrow by and by: what does not fit a drifted
start may well fit in the end.

Source: Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self, TypeAlias

import gtsam
import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray, checked
from fusion.errors import SkyfixError
from fusion.graph.covariances import noises_of, turned

_KERNELS = gtsam.noiseModel.mEstimator


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """The pose of one node seen from another, by registration; wrong ones lose their weight (dynamic covariances).

    Parameters
    ----------
    first, second : int
        Nodes.
    delta : (3,) float64
        Pose of the second in the body frame of the first.
    covariance : (3, 3) float64
        Of `delta`, on the axes of the first's body.
    width : float
        The loss of Agarwal et al. ("Robust map optimization using dynamic covariance scaling", ICRA 2013) lets go of
        residuals beyond about so many standard deviations.
    """

    first: int
    second: int
    delta: FloatArray
    covariance: FloatArray
    width: float = 3.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "delta", checked("loop closure delta", self.delta, (3,)))
        object.__setattr__(self, "covariance", _covariance("loop closure", self.covariance, 3))
        _check_width(self.width)

    @property
    def nodes(self) -> tuple[int, ...]:
        """The nodes that it binds."""
        return self.first, self.second

    def on(self, first: int, second: int) -> Self:
        """The same on other nodes."""
        return replace(self, first=first, second=second)

    def factor(self, widening: float, first: int, second: int) -> gtsam.NonlinearFactor:
        """GTSAM's factor between two keys, its loss so many times as wide."""
        [noise] = noises_of(self.covariance[None], self.delta[None, 2])
        robust = gtsam.noiseModel.Robust.Create(self._loss(widening), noise)
        return gtsam.BetweenFactorPose2(first, second, gtsam.Pose2(*self.delta), robust)

    def residual(self, poses: FloatArray) -> float:
        """How far poses (N, 3) are from what was seen, in standard deviations: a Mahalanobis distance."""
        off = se2.log(se2.between(self.delta, se2.between(poses[self.first], poses[self.second])))
        return float(np.sqrt(off @ np.linalg.solve(turned(self.covariance, -self.delta[2]), off)))

    def weight(self, residual: float) -> float:
        """Share of its information, in [0, 1], that the loss leaves it at a residual in standard deviations."""
        return float(self._loss(1.0).weight(residual))

    def _loss(self, widening: float) -> gtsam.noiseModel.mEstimator.DCS:
        return _KERNELS.DCS.Create((widening * self.width) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteFix:
    """A position in the map frame, such as GNSS gives; wrong ones lose their weight (Cauchy).

    Parameters
    ----------
    node : int
        Of which pose.
    position : (2,) float64
        x and y.
    covariance : (2, 2) float64
        On the axes of the map.
    width : float
        Where the loss bends, in standard deviations.
    """

    node: int
    position: FloatArray
    covariance: FloatArray
    width: float = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checked("fix position", self.position, (2,)))
        object.__setattr__(self, "covariance", _covariance("fix", self.covariance, 2))
        _check_width(self.width)

    @property
    def nodes(self) -> tuple[int, ...]:
        """The node that it binds."""
        return (self.node,)

    def on(self, node: int) -> Self:
        """The same on another node."""
        return replace(self, node=node)

    def factor(self, widening: float, key: int) -> gtsam.NonlinearFactor:
        """GTSAM's factor on a key, its loss so many times as wide."""
        noise = gtsam.noiseModel.Gaussian.Covariance(self.covariance, False)
        robust = gtsam.noiseModel.Robust.Create(self._loss(widening), noise)
        return gtsam.PoseTranslationPrior2D(key, self.position, robust)

    def residual(self, poses: FloatArray) -> float:
        """How far poses (N, 3) are from what was seen, in standard deviations: a Mahalanobis distance."""
        off = poses[self.node, :2] - self.position
        return float(np.sqrt(off @ np.linalg.solve(self.covariance, off)))

    def weight(self, residual: float) -> float:
        """Share of its information, in [0, 1], that the loss leaves it at a residual in standard deviations."""
        return float(self._loss(1.0).weight(residual))

    def _loss(self, widening: float) -> gtsam.noiseModel.mEstimator.Cauchy:
        return _KERNELS.Cauchy.Create(widening * self.width)


OtherFactor: TypeAlias = LoopClosure | AbsoluteFix


def bound_nodes(others: Sequence[OtherFactor], count: int) -> IntArray:
    """The nodes that factors bind, sorted.

    Raises
    ------
    SkyfixError
        When one is not in [0, count), or a loop closes on its own node.
    """
    for other in others:
        if len(set(other.nodes)) < len(other.nodes) or not all(0 <= node < count for node in other.nodes):
            raise SkyfixError(f"factor: expected different nodes in [0, {count}), got {other.nodes}")
    return np.unique(np.array([node for other in others for node in other.nodes], dtype=np.int64))


def native_factors(others: Sequence[OtherFactor], kept: IntArray, widening: float = 1.0) -> list[gtsam.NonlinearFactor]:
    """GTSAM's factors, with wider losses; keys are the places of the nodes among those that are kept, sorted."""
    return [other.factor(widening, *np.searchsorted(kept, other.nodes).tolist()) for other in others]


def _covariance(name: str, value: FloatArray, size: int) -> FloatArray:
    covariance = checked(f"{name} covariance", value, (size, size))
    skew = np.abs(covariance - covariance.T).max()
    if skew > 1e-9 * np.abs(covariance).max() or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise SkyfixError(f"{name} covariance: expected symmetric positive definite, got one that is not")
    return covariance


def _check_width(width: float) -> None:
    if not (np.isfinite(width) and width > 0.0):
        raise SkyfixError(f"width: expected > 0, got {width}")
