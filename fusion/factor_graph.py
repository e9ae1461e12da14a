"""Offline smoothing of a whole drive: a chain of poses in GTSAM, with the modes of every measurement as factors.

Between neighbouring nodes stands an odometry factor; on a measured node one Gaussian factor, the mode that is chosen.
Choosing and optimising alternate until the choices hold (see `fusion.hypotheses`).

GTSAM speaks in body-frame tangent vectors: an error of a factor on a pose with yaw t is ``R(t)^T`` times that on the
axes of the map, to first order. Covariances are turned accordingly, on the way in and on the way out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.hypotheses import Hypotheses
from fusion.odometry import OdometryIncrement
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory, checked_stamps

_LEAST_VARIANCE = 1e-15
_UNKNOWN_START = np.diag([9.0, 9.0, np.deg2rad(10.0) ** 2])  # of start values that come without covariances


@dataclass(frozen=True, slots=True)
class SmootherSettings:
    """How the smoother behaves.

    Parameters
    ----------
    outlier_probability : float
        Prior chance that no mode of a measurement is right, in (0, 1).
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
        if not 0.0 < self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in (0, 1), got {self.outlier_probability}")
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
        Index of the mode used at each node, or `hypotheses.REJECTED` (-1), or `hypotheses.NOT_MEASURED` (-2).
    iterations : int
        Rounds of choosing and optimising.
    converged : bool
        Whether the choices held in the end.
    cost : float
        Half the sum of squared whitened residuals (robust ones weighed) at the solution: its negative log posterior up
        to a constant, to compare smoothings of the same measurements by.
    """

    trajectory: Trajectory
    chosen: IntArray
    iterations: int
    converged: bool
    cost: float


def smooth(
    stamps_ns: ArrayLike,
    increments: Sequence[OdometryIncrement],
    measurements: Sequence[GaussianMixture | None],
    prior: UniformPrior,
    initial: Trajectory,
    settings: SmootherSettings | None = None,
) -> SmootherResult:
    """Most probable trajectory given all odometry and all measurements.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Times of the nodes, strictly increasing.
    increments : sequence of N - 1 OdometryIncrement
        Motion from each node to the next.
    measurements : sequence of N GaussianMixture or None
        Modes seen at each node, tempered for errors that are correlated in time.
    prior : UniformPrior
        Of the first node; enters as the Gaussian with the box's mean and covariance.
    initial : Trajectory
        Start values covering the stamps, such as the filter's; its covariances guide the first choice of modes.
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
    hypotheses = Hypotheses.of(measurements)
    chain = _chain(increments, prior, settings)
    poses = initial.interpolate(stamps)
    covariances = _covariances_near(stamps, initial)
    p, clutter = settings.outlier_probability, settings.clutter_log_density
    choice = hypotheses.choose(poses, covariances, p, clutter)
    seen: set[bytes] = set()
    while True:
        seen.add(choice.tobytes())
        poses, covariances, cost = _optimise(chain, hypotheses, choice, poses)
        cavities = hypotheses.cavities(poses, covariances, choice)
        revised = hypotheses.choose(*cavities, p, clutter)
        converged = bool((revised == choice).all())
        if converged or len(seen) == settings.max_iterations or revised.tobytes() in seen:
            return SmootherResult(Trajectory(stamps, poses, covariances), choice, len(seen), converged, cost)
        choice = revised


def _covariances_near(stamps: IntArray, initial: Trajectory) -> FloatArray:
    """Covariances (N, 3, 3) of the start values: those of the last pose at or before each stamp."""
    if initial.covariances is None:
        return np.repeat(_UNKNOWN_START[None], len(stamps), axis=0)
    at = np.searchsorted(initial.stamp_ns, stamps, side="right") - 1
    return _positive_definite(initial.covariances[np.maximum(at, 0)])


def _positive_definite(covariances: FloatArray) -> FloatArray:
    """Symmetric with eigenvalues of at least the least variance; (..., 3, 3)."""
    values, vectors = np.linalg.eigh(0.5 * (covariances + covariances.swapaxes(-1, -2)))
    if values.min() >= _LEAST_VARIANCE:
        return 0.5 * (covariances + covariances.swapaxes(-1, -2))
    return (vectors * np.maximum(values, _LEAST_VARIANCE)[..., None, :]) @ vectors.swapaxes(-1, -2)


def _turned(covariances: FloatArray, yaw: ArrayLike) -> FloatArray:
    """Covariances (..., 3, 3) on axes that are turned by `yaw` (...)."""
    turn = se2.rotation(yaw)
    return turn @ covariances @ turn.swapaxes(-1, -2)


def _noise(covariance: FloatArray, yaw: float) -> gtsam.noiseModel.Gaussian:
    """Noise of a factor at a pose with that yaw, from a covariance on the axes of the frame above."""
    return gtsam.noiseModel.Gaussian.Covariance(_positive_definite(_turned(covariance, -yaw)), False)


def _robust(noise: gtsam.noiseModel.Gaussian, settings: SmootherSettings) -> gtsam.noiseModel.Base:
    if settings.odometry_kernel == "none":
        return noise
    width, kernels = settings.odometry_kernel_width, gtsam.noiseModel.mEstimator
    kernel = kernels.Huber.Create(width) if settings.odometry_kernel == "huber" else kernels.DCS.Create(width)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


def _chain(
    increments: Sequence[OdometryIncrement], prior: UniformPrior, settings: SmootherSettings
) -> gtsam.NonlinearFactorGraph:
    """Prior and odometry, the part of the graph that does not change."""
    graph = gtsam.NonlinearFactorGraph()
    mean = prior.mean
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*mean), _noise(prior.covariance, mean[2])))
    for node, increment in enumerate(increments):
        delta = increment.delta
        noise = _robust(_noise(increment.covariance, delta[2]), settings)
        graph.add(gtsam.BetweenFactorPose2(node, node + 1, gtsam.Pose2(*delta), noise))
    return graph


def _optimise(
    chain: gtsam.NonlinearFactorGraph, hypotheses: Hypotheses, choice: IntArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Poses (N, 3), map-frame marginal covariances (N, 3, 3) and cost with the chosen modes as factors."""
    graph = gtsam.NonlinearFactorGraph(chain)
    for row in hypotheses.chosen_rows(choice):
        mean = hypotheses.means[row]
        noise = _noise(hypotheses.covariances[row], mean[2])
        graph.add(gtsam.PriorFactorPose2(int(hypotheses.node[row]), gtsam.Pose2(*mean), noise))
    values = gtsam.Values()
    for node, pose in enumerate(start):
        values.insert(node, gtsam.Pose2(*pose))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    try:
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        marginals = gtsam.Marginals(graph, values)
        covariances = np.array([marginals.marginalCovariance(node) for node in range(len(start))])
    except RuntimeError as error:
        raise SkyfixError(f"smoother: expected a solvable graph, got {str(error).strip().splitlines()[0]}") from error
    poses = np.array(gtsam.utilities.extractPose2(values)).reshape(-1, 3)
    cost = float(graph.error(values))
    if not (np.isfinite(cost) and np.isfinite(poses).all() and np.isfinite(covariances).all()):
        raise SkyfixError("smoother: expected a finite solution, got NaN or an infinity")
    return poses, _positive_definite(_turned(covariances, poses[:, 2])), cost
