"""Several places at once: a fixed-lag smoother from each of some starts, weighed by what each makes of the likelihoods.

    tracker = HypothesisSmoother(stamp_ns, filter.estimate(stamp_ns, max_modes=4).modes)
    tracker.add_odometry(increment)
    tracker.add_likelihood(stamp_ns, likelihood)
    tracker.hypotheses()
    tracker.estimate(max_modes=4)

One Gaussian a hypothesis: two streets that look alike are two hypotheses, each smoothed on its own street, and their
weights are the shares of the evidence, ``w_i prod_k p(z_k | z_<k, i)``. Where hypotheses are apart, each sees only the
part of a likelihood that it predicts better than the others, so that the mass of one street is never the evidence of
another's. Where they have come together they see the same mass and are made one, with the sum of their weights.

New hypotheses never arise: a filter over the whole map finds places (`Tracker` has both side by side).

Source: Blom, Bar-Shalom, "The interacting multiple model algorithm", IEEE Transactions on Automatic Control, 1988, for
the weights and the moments; there is no switching between hypotheses here.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import FloatArray, keep_plain
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.fixed_lag import FixedLagSettings, FixedLagSmoother, LagCounts, LagReport, LagState
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.basins import around, distance, own_part
from fusion.graph.measurements import Measurement
from fusion.graph.patch import LikelihoodPatch, patch_of, without_outliers
from fusion.odometry import OdometryIncrement
from fusion.tracking.tracker_input import check_likelihood, checked_stamp
from fusion.tracking.tracker_report import Outcome
from fusion.trajectory import Trajectory

__all__ = ["Hypothesis", "HypothesisSettings", "HypothesisSmoother", "HypothesisState"]


@dataclass(frozen=True, slots=True)
class HypothesisSettings:
    """When hypotheses end.

    Parameters
    ----------
    least_share : float
        One with less of the weight is given up, in [0, 1).
    merge_distance : float
        Two whose newest poses are nearer, in standard deviations of their difference, are made one.
    apart_distance : float
        Two that are farther divide the likelihood between them; at least `merge_distance`.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    least_share: float = 1e-4
    merge_distance: float = 0.5
    apart_distance: float = 2.0

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        if not 0.0 <= self.least_share < 1.0:
            raise SkyfixError(f"least_share: expected in [0, 1), got {self.least_share}")
        if not 0.0 < self.merge_distance <= self.apart_distance:
            got = f"{self.merge_distance} and {self.apart_distance}"
            raise SkyfixError(f"merge_distance: expected > 0 and at most apart_distance, got {got}")


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One place where the vehicle may be.

    Parameters
    ----------
    weight : float
        Its share.
    pose, covariance : (3,), (3, 3) float64
        Newest pose, on the axes of the map.
    trajectory : Trajectory
        All poses held.
    """

    weight: float
    pose: FloatArray
    covariance: FloatArray
    trajectory: Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisState:
    """All that a `HypothesisSmoother` knows; it never changes.

    Parameters
    ----------
    log_weights : (H,) float64
        Normalised.
    smoothers : tuple of H LagState
        One a hypothesis.
    log_evidence, last_log_evidence : float
        ln density of all likelihoods used, and of the last to come, given those before; of all hypotheses together.
    """

    log_weights: FloatArray
    smoothers: tuple[LagState, ...]
    log_evidence: float = 0.0
    last_log_evidence: float = 0.0


class HypothesisSmoother:
    """Fixed-lag smoothers with weights, all given the same messages.

    Parameters
    ----------
    stamp_ns : int
        Of the first pose.
    starts : GaussianMixture
        First poses: a filter's clusters, `Estimate.modes`. Weights are made to sum to 1.
    settings : HypothesisSettings
        When hypotheses end.
    smoother_settings : FixedLagSettings
        How each smoother behaves.
    """

    def __init__(
        self,
        stamp_ns: int,
        starts: GaussianMixture,
        settings: HypothesisSettings | None = None,
        smoother_settings: FixedLagSettings | None = None,
    ) -> None:
        self.settings = settings or HypothesisSettings()
        self.smoother_settings = smoother_settings or FixedLagSettings()
        self._smoothers = [
            FixedLagSmoother(stamp_ns, mean, covariance, self.smoother_settings)
            for mean, covariance in zip(starts.means, starts.covariances, strict=True)
        ]
        self._log_weights = np.log(starts.weights) - np.log(starts.weights.sum())
        self._log_evidence = self._last_log_evidence = 0.0
        self._end_some()

    def __len__(self) -> int:
        """Number of hypotheses."""
        return len(self._smoothers)

    @property
    def weights(self) -> FloatArray:
        """Shares (H,), in the order of the starts that are left."""
        return np.exp(self._log_weights)

    @property
    def counts(self) -> LagCounts:
        """Messages so far."""
        return self._smoothers[0].counts

    @property
    def log_evidence(self) -> float:
        """ln density of all likelihoods used, each given those before it."""
        return self._log_evidence

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the oldest and the newest pose held."""
        return self._smoothers[0].span_ns

    def hypotheses(self) -> list[Hypothesis]:
        """All of them, in the order of the starts that are left."""
        found = []
        for weight, smoother in zip(self.weights.tolist(), self._smoothers, strict=True):
            estimate = smoother.estimate()
            found.append(Hypothesis(weight, estimate.pose, estimate.covariance, smoother.trajectory()))
        return found

    def state(self) -> HypothesisState:
        """All that is known, to go back to."""
        states = tuple(smoother.state() for smoother in self._smoothers)
        return HypothesisState(self._log_weights, states, self._log_evidence, self._last_log_evidence)

    def restore(self, state: HypothesisState) -> None:
        """Go back to a state."""
        self._smoothers = [FixedLagSmoother.from_state(one, self.smoother_settings) for one in state.smoothers]
        self._log_weights = state.log_weights
        self._log_evidence, self._last_log_evidence = state.log_evidence, state.last_log_evidence

    def add_odometry(self, increment: OdometryIncrement) -> LagReport:
        """Add a pose to every hypothesis, see `FixedLagSmoother.add_odometry`."""
        before = self.state()
        try:
            reports = [smoother.add_odometry(increment) for smoother in self._smoothers]
        except Exception:
            self.restore(before)
            raise
        return reports[0]

    def add_likelihood(self, stamp_ns: int, likelihood: Measurement) -> LagReport:
        """Add a measurement to every hypothesis and weigh them, see `FixedLagSmoother.add_likelihood`.

        The evidence is that of all hypotheses together.
        """
        before = self.state()
        try:
            parts = self._parts(checked_stamp(stamp_ns), likelihood)
            reports = [one.add_likelihood(stamp_ns, part) for one, part in zip(self._smoothers, parts, strict=True)]
        except Exception:
            self.restore(before)
            raise
        if reports[0].outcome is not Outcome.USED:
            return reports[0]
        log_weights = self._log_weights + np.array([report.log_evidence for report in reports])
        self._last_log_evidence = float(logsumexp(log_weights))
        self._log_evidence += self._last_log_evidence
        self._log_weights = log_weights - self._last_log_evidence
        self._end_some()
        return LagReport(Outcome.USED, self._last_log_evidence)

    def estimate(self, max_modes: int = 0) -> Estimate:
        """Mean, circular in yaw, and covariance of all hypotheses; the heaviest when `max_modes` is not 0."""
        found, weights = self.hypotheses(), self.weights
        poses = np.array([one.pose for one in found])
        covariances = np.array([one.covariance for one in found])
        mean, between = se2.weighted_mean_and_covariance(poses, weights)
        modes = None
        if max_modes:
            heaviest = np.argsort(-weights, kind="stable")[:max_modes]
            modes = GaussianMixture(weights[heaviest] / max(1.0, weights.sum()), poses[heaviest], covariances[heaviest])
        covariance = np.einsum("h,hij->ij", weights / weights.sum(), covariances) + between
        stamp_ns, size = self.span_ns[1], float(1.0 / (weights**2).sum())
        return Estimate(stamp_ns, mean, covariance, modes, size, self._last_log_evidence, 0.0)

    def _parts(self, stamp_ns: int, likelihood: Measurement) -> list[Measurement]:
        """What each hypothesis is to see of a likelihood: the cells that none of those apart predicts better."""
        if isinstance(likelihood, GaussianMixture) or len(self) == 1:
            return [likelihood] * len(self)
        if not isinstance(likelihood, LikelihoodPatch):
            if isinstance(without_outliers(likelihood)[0], GaussianLikelihood):
                return [likelihood] * len(self)
            check_likelihood(likelihood)
        there = [smoother.prediction(stamp_ns) for smoother in self._smoothers]
        parts: list[Measurement] = []
        for own in there:
            others = [other for other in there if other is not own and self._is_apart(own, other)]
            parts.append(own_part(patch_of(likelihood, around(*own)), own, others))
        return parts

    def _is_apart(self, a: tuple[FloatArray, FloatArray], b: tuple[FloatArray, FloatArray]) -> bool:
        return distance(a, b) > self.settings.apart_distance

    def _end_some(self) -> None:
        """Give up those of too little weight, the heaviest excepted, and make one of those that coincide."""
        newest = [(one.pose, one.covariance) for one in (smoother.estimate() for smoother in self._smoothers)]
        kept: list[int] = []
        log_weights = self._log_weights.copy()
        for place in np.argsort(-log_weights, kind="stable").tolist():
            if kept and log_weights[place] < np.log(max(self.settings.least_share, 1e-300)):
                continue
            same = [one for one in kept if distance(newest[one], newest[place]) < self.settings.merge_distance]
            if same:
                log_weights[same[0]] = np.logaddexp(log_weights[same[0]], log_weights[place])
            else:
                kept.append(place)
        kept.sort()
        self._smoothers = [self._smoothers[place] for place in kept]
        self._log_weights = log_weights[kept] - logsumexp(log_weights[kept])
