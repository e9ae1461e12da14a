"""Offline smoothing of a whole drive: a chain of poses in GTSAM, with whole likelihoods as factors.

Between neighbouring nodes stands an odometry factor; on a measured node the Gaussian that has the likelihood's effect
there, found anew in every round (see `fusion.graph.propagation`). Mixtures of a few modes can be had in place of whole
likelihoods. Covariances are those of the probability mass, not of the curvature at a peak.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.covariances import noises_of, positive_definite
from fusion.graph.measurements import Measurement, Measurements
from fusion.graph.pose_graph import PoseGraph
from fusion.graph.propagation import propagate
from fusion.odometry import OdometryIncrement
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory, checked_stamps

_UNKNOWN_START = np.diag([9.0, 9.0, np.deg2rad(10.0) ** 2])  # of start values that come without covariances
_WIDTHS = ()


@dataclass(frozen=True, slots=True)
class SmootherSettings:
    """How the smoother behaves.

    Parameters
    ----------
    outlier_probability : float
        Prior chance that a measurement says nothing, in [0, 1).
    clutter_log_density : float
        ln density per m^2 rad of a measurement that is about nothing: `fusion.likelihood.log_uniform_density` of the
        crop. The default is that of 40 m x 40 m with all headings.
    odometry_kernel : {"huber", "dcs", "none"}
        Robust loss of the odometry factors, for a registration that failed. Measurements have the null hypothesis.
    odometry_kernel_width : float
        Where that loss bends, in standard deviations.
    max_iterations : int
        Most rounds of choosing and optimising.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    outlier_probability: float = 0.05
    clutter_log_density: float = -9.2
    odometry_kernel: Literal["huber", "dcs", "none"] = "huber"
    odometry_kernel_width: float = 4.0
    max_iterations: int = 20

    def __post_init__(self) -> None:
        if not 0.0 <= self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in [0, 1), got {self.outlier_probability}")
        if not np.isfinite(self.clutter_log_density):
            raise SkyfixError(f"clutter_log_density: expected a number, got {self.clutter_log_density}")
        if self.odometry_kernel not in ("huber", "dcs", "none"):
            raise SkyfixError(f"odometry_kernel: expected huber, dcs or none, got {self.odometry_kernel!r}")
        if not self.odometry_kernel_width > 0.0:
            raise SkyfixError(f"odometry_kernel_width: expected > 0, got {self.odometry_kernel_width}")
        if self.max_iterations < 1:
            raise SkyfixError(f"max_iterations: expected >= 1, got {self.max_iterations}")


@dataclass(frozen=True, slots=True, eq=False)
class SmootherResult:
    """What the smoother found.

    Parameters
    ----------
    trajectory : Trajectory
        Smoothed poses with marginal covariances on the axes of the map.
    chosen : (N,) int64
        Which mode of its mixture explains each node best, 0 for a whole likelihood, `REJECTED` (-1) where an outlier
        explains better, `NOT_MEASURED` (-2) elsewhere.
    iterations : int
        Rounds of finding factors and solving.
    converged : bool
        Whether the last round changed nothing to speak of.
    log_evidence : float
        ln density of all measurements given the odometry, up to a constant, to compare smoothings of the same
        measurements by.
    """

    trajectory: Trajectory
    chosen: IntArray
    iterations: int
    converged: bool
    log_evidence: float


def smooth(
    stamps_ns: ArrayLike,
    increments: Sequence[OdometryIncrement],
    measurements: Sequence[Measurement | None],
    prior: UniformPrior,
    initial: Trajectory,
    settings: SmootherSettings | None = None,
) -> SmootherResult:
    """Trajectory given all odometry and all measurements.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Times of the nodes, strictly increasing.
    increments : sequence of N - 1 OdometryIncrement
        Motion from each node to the next.
    measurements : sequence of N Measurement or None
        What was seen at each node: a likelihood, the patch of one, or the modes of one; tempered for errors that are
        correlated in time.
    prior : UniformPrior
        Of the first node; enters as the Gaussian with the box's mean and covariance.
    initial : Trajectory
        Start values covering the stamps, such as the filter's, and how far they can be trusted.
    settings : SmootherSettings
        How the smoother behaves.

    Raises
    ------
    SkyfixError
        When the numbers of items or their stamps disagree, or the optimisation diverges.
    """
    settings = settings or SmootherSettings()
    stamps = checked_stamps(stamps_ns)
    if len(increments) != len(stamps) - 1 or len(measurements) != len(stamps):
        raise SkyfixError(
            f"smoother: expected {len(stamps) - 1} increments and {len(stamps)} measurements, "
            f"got {len(increments)} and {len(measurements)}"
        )
    if any(increment.stamp_ns != stamp for increment, stamp in zip(increments, stamps[1:], strict=True)):
        raise SkyfixError("increments: expected one ending at every stamp after the first, got other stamps")
    seen = Measurements(measurements, settings.outlier_probability, settings.clutter_log_density)
    graph = PoseGraph(_chain(increments, prior, settings), len(stamps), is_chain=True)
    poses, covariances = initial.interpolate(stamps), _covariances_near(stamps, initial)
    found = propagate(graph, seen, poses, covariances, _WIDTHS, settings.max_iterations)
    assert found.solution.covariances is not None  # every round asks for them
    trajectory = Trajectory(stamps, found.solution.poses, found.solution.covariances)
    return SmootherResult(trajectory, found.chosen, found.rounds, found.converged, found.log_evidence)


def _covariances_near(stamps: IntArray, initial: Trajectory) -> FloatArray:
    """Covariances (N, 3, 3) of the start values: those of the last pose at or before each stamp."""
    if initial.covariances is None:
        return np.repeat(_UNKNOWN_START[None], len(stamps), axis=0)
    at = np.searchsorted(initial.stamp_ns, stamps, side="right") - 1
    return positive_definite(initial.covariances[np.maximum(at, 0)])


def _chain(
    increments: Sequence[OdometryIncrement], prior: UniformPrior, settings: SmootherSettings
) -> gtsam.NonlinearFactorGraph:
    """Prior and odometry."""
    deltas = np.array([prior.mean, *(increment.delta for increment in increments)])
    covariances = np.array([prior.covariance, *(increment.covariance for increment in increments)])
    first, *noises = noises_of(covariances, deltas[:, 2])
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*prior.mean), first))
    width, kernels = settings.odometry_kernel_width, gtsam.noiseModel.mEstimator
    if settings.odometry_kernel != "none":
        kernel = kernels.Huber.Create(width) if settings.odometry_kernel == "huber" else kernels.DCS.Create(width)
        noises = [gtsam.noiseModel.Robust.Create(kernel, noise) for noise in noises]
    for node, ((x, y, yaw), noise) in enumerate(zip(deltas[1:].tolist(), noises, strict=True)):
        graph.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(x, y, yaw), noise))
    return graph
