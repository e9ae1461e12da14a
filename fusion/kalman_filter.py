"""An unscented Kalman filter: one Gaussian, filterpy's sigma points. A baseline.

A likelihood enters as its modes; among those within the gate around the prediction the heaviest is taken for a Gaussian
measurement of the whole pose. Headings are averaged on the circle and subtracted the short way round.

What it cannot do: hold two hypotheses. It starts from one Gaussian, so an unknown heading or a start anywhere on the
map is beyond it; where streets repeat it settles on the mode that is heaviest within its gate, and when that was
wrong its covariance will not say so: every later true mode lies outside the gate, counts as an outlier, and there is no
recovery. Its evidence knows one mode of the likelihood and none of its skirts. `ParticleFilter` and `GridFilter` do
these things; where the prediction and the measurement are Gaussian all three agree.

Sources: Julier, Uhlmann, "New extension of the Kalman filter to nonlinear systems", 1997; van der Merwe's scaled sigma
points in filterpy; gating: Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation",
2001, section 2.3.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import ArrayLike
from scipy.stats import chi2

from fusion import se2
from fusion.arrays import FloatArray, checked
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.gaussian_mixture import GaussianMixture
from fusion.likelihood import PoseLikelihood, checked_temperature, log_uniform_density
from fusion.odometry import OdometryIncrement
from fusion.pose_filter import UpdateReport
from fusion.prior import UniformPrior

_SPREAD = 0.5  # alpha: where the sigma points lie, in (0, 1]
_GAUSSIAN = 2.0  # beta: best for a Gaussian
_LEAST_VARIANCE = np.diag([1e-9, 1e-9, 1e-12])  # keeps a start that is certain factorable


@dataclass(frozen=True, slots=True)
class KalmanFilterSettings:
    """How the filter behaves.

    Parameters
    ----------
    outlier_probability : float
        Chance that a measurement is about nothing, in (0, 1); its share of the evidence.
    gate_probability : float
        Chance that the right mode lies within the gate, in (0, 1).
    max_modes : int
        Modes of a likelihood that are looked at, the highest first.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    outlier_probability: float = 0.05
    gate_probability: float = 0.999
    max_modes: int = 5

    def __post_init__(self) -> None:
        for name in ("outlier_probability", "gate_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise SkyfixError(f"{name}: expected in (0, 1), got {getattr(self, name)}")
        if self.max_modes < 1:
            raise SkyfixError(f"max_modes: expected >= 1, got {self.max_modes}")


class KalmanFilter:
    """One Gaussian over (x, y, yaw) in the map frame.

    Parameters
    ----------
    mean : (3,) array_like
        First pose.
    covariance : (3, 3) array_like
        Of the first pose, on the axes of the map, positive semidefinite.
    settings : KalmanFilterSettings
        How the filter behaves.

    Raises
    ------
    SkyfixError
        When a value is not finite or the covariance is no covariance.
    """

    def __init__(self, mean: ArrayLike, covariance: ArrayLike, settings: KalmanFilterSettings | None = None) -> None:
        pose = checked("mean", mean, (3,)).copy()
        spread = checked("covariance", covariance, (3, 3))
        if np.abs(spread - spread.T).max() > 1e-9 * np.abs(spread).max():
            raise SkyfixError("covariance: expected a symmetric matrix, got one that is not")
        if np.linalg.eigvalsh(spread)[0] < -1e-9 * np.abs(spread).max():
            raise SkyfixError("covariance: expected positive semidefinite, got a negative eigenvalue")
        pose[2] = se2.wrap(pose[2])
        self.settings = settings or KalmanFilterSettings()
        self._gate = float(chi2.ppf(self.settings.gate_probability, 3))
        self._filter = UnscentedKalmanFilter(
            dim_x=3,
            dim_z=3,
            dt=1.0,
            hx=np.asarray,
            fx=_moved,
            points=MerweScaledSigmaPoints(3, _SPREAD, _GAUSSIAN, 0.0, subtract=_difference),
            x_mean_fn=_mean,
            z_mean_fn=_mean,
            residual_x=_difference,
            residual_z=_difference,
            state_add=_sum,
        )
        self._filter.x, self._filter.P = pose, 0.5 * (spread + spread.T) + _LEAST_VARIANCE
        self._log_evidence = 0.0

    @classmethod
    def from_prior(cls, prior: UniformPrior, settings: KalmanFilterSettings | None = None) -> Self:
        """A filter with the mean and covariance of a prior's box."""
        return cls(prior.mean, prior.covariance, settings)

    def predict(self, increment: OdometryIncrement) -> None:
        """Move by the increment and spread by its covariance."""

        def move() -> None:
            turn = se2.rotation(self._filter.x[2])
            self._filter.Q = turn @ increment.covariance @ turn.T
            self._filter.predict(delta=increment.delta)

        self._attempt(move)

    def update(self, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        """Measure the pose by the heaviest mode within the gate; by none when all lie outside.

        Parameters
        ----------
        likelihood : PoseLikelihood
            Not masked by a prior, not tempered, without outliers: both are done here.
        temperature : float
            Multiplies the covariance of the modes, for errors shared with the previous measurement.

        Raises
        ------
        SkyfixError
            When the likelihood gives no proper modes; the filter is then as it was before.
        """
        modes = likelihood.modes(self.settings.max_modes).tempered(checked_temperature(temperature))
        innovation = np.array([_difference(mean, self._filter.x) for mean in modes.means])
        spread = self._filter.P + modes.covariances
        distance = np.einsum("mi,mi->m", innovation, np.linalg.solve(spread, innovation[..., None])[..., 0])
        within = np.flatnonzero(distance <= self._gate)
        outlier = self.settings.outlier_probability
        log_evidence = float(np.log(outlier) + log_uniform_density(likelihood.grid))
        if len(within):
            best = within[np.argmax(modes.weights[within])]
            predicted = GaussianMixture(modes.weights[best : best + 1], self._filter.x[None], spread[best : best + 1])
            right = np.log1p(-outlier) + float(predicted.log_density(modes.means[best : best + 1])[0])
            log_evidence = float(np.logaddexp(log_evidence, right))
            self._attempt(lambda: self._measure(modes.means[best], modes.covariances[best]))
        self._log_evidence = log_evidence
        return UpdateReport(log_evidence, effective_sample_size=1.0)

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """The Gaussian; as its only mode too when `max_modes` is not 0."""
        pose, covariance = self._filter.x.copy(), self._filter.P.copy()
        modes = GaussianMixture(np.ones(1), pose[None], covariance[None]) if max_modes else None
        return Estimate(stamp_ns, pose, covariance, modes, 1.0, self._log_evidence, 0.0)

    def _measure(self, mean: FloatArray, covariance: FloatArray) -> None:
        self._filter.sigmas_f = self._filter.points_fn.sigma_points(self._filter.x, self._filter.P)
        self._filter.update(mean, R=covariance)

    def _attempt(self, step: Callable[[], None]) -> None:
        """Take a step of filterpy's; back to where it was if the result is no Gaussian."""
        pose, covariance = self._filter.x.copy(), self._filter.P.copy()
        try:
            step()
            symmetric = 0.5 * (self._filter.P + self._filter.P.T)
            np.linalg.cholesky(symmetric)
        except np.linalg.LinAlgError as error:
            self._filter.x, self._filter.P = pose, covariance
            raise SkyfixError("kalman filter: expected a positive definite covariance, got one that is not") from error
        self._filter.P = symmetric


def _moved(pose: FloatArray, dt: float, delta: FloatArray) -> FloatArray:
    return se2.compose(pose, delta)


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a - b``, the heading the short way round."""
    difference = np.subtract(a, b)
    difference[2] = se2.wrap(difference[2])
    return difference


def _sum(a: FloatArray, b: FloatArray) -> FloatArray:
    total = np.add(a, b)
    total[2] = se2.wrap(total[2])
    return total


def _mean(poses: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean (3,) of poses (N, 3), headings by the short way from the first: with weights below zero the
    resultant of widely spread ones points the other way."""
    mean = weights @ poses
    mean[2] = se2.wrap(poses[0, 2] + weights @ se2.wrap(poses[:, 2] - poses[0, 2]))
    return np.asarray(mean)
