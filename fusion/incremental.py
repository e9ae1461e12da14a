"""The factor graph online with the whole drive in memory, so that places seen again and absolute positions can join it.

    smoother = IncrementalSmoother.from_prior(stamp_ns, prior)
    smoother.add_odometry(increment)
    smoother.add_likelihood(stamp_ns, likelihood)
    smoother.add(LoopClosure(first, second, delta, covariance))
    smoother.estimate().pose
    smoother.trajectory()

The graph is solved by GTSAM's ISAM2, which works again on what a message changes and no more. Whole likelihoods count
as they do in `fusion.factor_graph.smooth`: each stands in the graph as the Gaussian that has its effect, found anew as
the estimate moves; of the newest ones in every update, of all when a loop closes or one comes late. Nothing is summed
over, so a likelihood may come as late as it likes, and memory grows with the drive: where it must not, and no loop can
close, take `FixedLagSmoother`.
"""

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Self

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, IntArray, checked
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.fixed_lag import LagCounts, LagReport
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.covariances import noises_of
from fusion.graph.isam_graph import IsamGraph, Name
from fusion.graph.kept_sites import KeptSite, KeptSites
from fusion.graph.lag_window import divided, kept_measurement
from fusion.graph.measurements import Measurement
from fusion.graph.other_factors import OtherFactor
from fusion.graph.patch import LikelihoodPatch
from fusion.odometry import OdometryIncrement
from fusion.prior import UniformPrior
from fusion.tracking.tracker_input import check_likelihood, checked_increment, checked_stamp
from fusion.tracking.tracker_report import Outcome
from fusion.trajectory import Trajectory

__all__ = ["IncrementalSettings", "IncrementalSmoother"]

_WIDENINGS = (16.0, 4.0, 1.0)  # of the loss of what has just joined: what fits no drifted estimate may fit in the end
_MOST_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class IncrementalSettings:
    """How the incremental smoother behaves.

    Parameters
    ----------
    newest : int
        So many of the newest likelihoods are looked at again in every update.
    outlier_probability, clutter_log_density, huber_width : float
        As in `FixedLagSettings`.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    newest: int = 20
    outlier_probability: float = 0.05
    clutter_log_density: float = -9.2
    huber_width: float = 4.0

    def __post_init__(self) -> None:
        if not isinstance(self.newest, int) or isinstance(self.newest, bool) or self.newest < 1:
            raise SkyfixError(f"newest: expected a whole number >= 1, got {self.newest!r}")
        if not 0.0 <= self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in [0, 1), got {self.outlier_probability}")
        if not np.isfinite(self.clutter_log_density):
            raise SkyfixError(f"clutter_log_density: expected a number, got {self.clutter_log_density}")
        if not self.huber_width > 0.0:
            raise SkyfixError(f"huber_width: expected > 0, got {self.huber_width}")


class IncrementalSmoother:
    """A whole drive, online.

    Poses are numbered along the drive from 0, those at the stamps of likelihoods that came between two increments
    included; `add` takes these numbers.

    Parameters
    ----------
    stamp_ns : int
        Of the first pose.
    mean : (3,) array_like
        ``[x, y, yaw]``, map frame.
    covariance : (3, 3) array_like
        Of the first pose on the axes of the map, positive definite.
    settings : IncrementalSettings
        How the smoother behaves.

    Raises
    ------
    SkyfixError
        When the stamp is not an int64, a value is not finite, or the covariance is not positive definite.
    """

    def __init__(
        self, stamp_ns: int, mean: ArrayLike, covariance: ArrayLike, settings: IncrementalSettings | None = None
    ) -> None:
        start = GaussianMixture(
            np.ones(1), checked("mean", mean, (3,))[None], checked("covariance", covariance, (3, 3))[None]
        )
        self.settings = settings or IncrementalSettings()
        self.counts = LagCounts()
        self.log_evidence = 0.0
        self._last_log_evidence = 0.0
        self._stamps, self._keys = [checked_stamp(stamp_ns)], [0]
        self._motions: dict[int, tuple[FloatArray, FloatArray]] = {}  # by the key of the pose where they end
        self._sites = KeptSites(self.settings.outlier_probability, self.settings.clutter_log_density)
        self._others: list[OtherFactor] = []
        self._graph = IsamGraph()
        [mean_], [noise] = start.means, noises_of(start.covariances, start.means[:, 2])
        self._graph.update({("prior", 0): gtsam.PriorFactorPose2(0, gtsam.Pose2(*mean_), noise)}, {0: mean_})

    @classmethod
    def from_prior(cls, stamp_ns: int, prior: UniformPrior, settings: IncrementalSettings | None = None) -> Self:
        """A smoother that begins with the mean and covariance of a prior's box."""
        return cls(stamp_ns, prior.mean, prior.covariance, settings)

    def __len__(self) -> int:
        """Number of poses."""
        return len(self._stamps)

    @property
    def stamps_ns(self) -> IntArray:
        """Of all poses (N,)."""
        return np.array(self._stamps, dtype=np.int64)

    def add_odometry(self, increment: OdometryIncrement) -> LagReport:
        """Add a pose by the motion from the newest.

        Raises
        ------
        SkyfixError
            When it is not an increment, its stamp is not an int64, or its values are out of all reason.
        """
        sample = checked_increment(increment)
        if sample.stamp_ns <= self._stamps[-1]:
            held = sample.stamp_ns in self._stamps
            return self._counted("duplicates" if held else "late_odometry", held)
        key, before = len(self._keys), self._keys[-1]
        [pose] = self._graph.poses([before])
        motion = increment.delta, increment.covariance
        self._graph.update({("motion", key): self._motion(before, key, *motion)}, {key: se2.compose(pose, motion[0])})
        self._motions[key] = motion
        self._stamps.append(sample.stamp_ns)
        self._keys.append(key)
        self._count("odometry")
        return LagReport(Outcome.USED)

    def add_likelihood(self, stamp_ns: int, likelihood: Measurement) -> LagReport:
        """Add a measurement anywhere along the drive and smooth.

        Parameters
        ----------
        stamp_ns : int
            From the first to the newest pose.
        likelihood : PoseLikelihood, LikelihoodPatch or GaussianMixture
            Tempered for errors that are correlated in time. An outlier probability of its own counts beside the
            settings'.

        Raises
        ------
        SkyfixError
            When the stamp is no int64 or lies beyond the newest pose, the likelihood is none or gives NaN, or nothing
            finite comes of it.
        """
        stamp_ns = checked_stamp(stamp_ns)
        if not isinstance(likelihood, (GaussianLikelihood, GaussianMixture, LikelihoodPatch)):
            check_likelihood(likelihood)
        if stamp_ns > self._stamps[-1]:
            raise SkyfixError(f"likelihood: expected a stamp up to the odometry's {self._stamps[-1]}, got {stamp_ns}")
        if stamp_ns < self._stamps[0]:
            return self._counted("too_late_likelihoods", False)
        place = bisect_left(self._stamps, stamp_ns)
        if self._stamps[place] == stamp_ns and self._keys[place] in self._sites:
            return self._counted("duplicates", True)
        late = any(key in self._sites for key in self._keys[place:])
        expected = self._expected(place, stamp_ns)
        after = self._graph.poses([self._keys[place]])
        kept = kept_measurement(likelihood, expected, self._graph.covariances([self._keys[place]], after)[0])
        if self._stamps[place] != stamp_ns:
            self._split(place, stamp_ns, expected)
        key = self._keys[place]
        poses = self._graph.poses([key])
        widths = self._graph.covariances([key], poses)
        site, log_evidence = self._sites.first(kept, poses[0], widths[0])
        self._take({key: site})
        self._refresh(self._sites.among(self._keys) if late else self._newest(), 1)
        self.log_evidence += log_evidence
        self._last_log_evidence = log_evidence
        self._count("likelihoods")
        if late:
            self._count("late_likelihoods")
        return LagReport(Outcome.USED, log_evidence)

    def add(self, other: OtherFactor) -> int:
        """Bind poses by something else; its nodes are numbers of poses as they are now.

        Returns
        -------
        Its place in `weights`.

        Raises
        ------
        SkyfixError
            When a node is no pose, or the graph cannot be solved with it; the smoother is then as it was.
        """
        nodes = other.nodes
        if len(set(nodes)) < len(nodes) or not all(0 <= node < len(self) for node in nodes):
            raise SkyfixError(f"factor: expected different nodes in [0, {len(self)}), got {nodes}")
        keys = [self._keys[node] for node in nodes]
        name = "other", len(self._others)
        measured = self._sites.among(self._keys)
        try:
            for widening in _WIDENINGS:
                self._graph.update({name: other.factor(widening, *keys)})
                self._refresh(measured, _MOST_ROUNDS)
        except SkyfixError:
            self._graph.update({}, without=[name])
            raise
        self._others.append(other.on(*keys))
        return len(self._others) - 1

    def weights(self) -> FloatArray:
        """Share of its information, in [0, 1], that the robust loss leaves each of what `add` was given."""
        poses = self._graph.poses(range(len(self._keys)))
        return np.array([other.weight(other.residual(poses)) for other in self._others], dtype=np.float64)

    def estimate(self, max_modes: int = 0) -> Estimate:
        """The newest pose; as its only mode too when `max_modes` is not 0. A graph has no model of being lost."""
        poses = self._graph.poses([self._keys[-1]])
        covariances = self._graph.covariances([self._keys[-1]], poses)
        modes = GaussianMixture(np.ones(1), poses, covariances) if max_modes else None
        return Estimate(self._stamps[-1], poses[0], covariances[0], modes, 1.0, self._last_log_evidence, 0.0)

    def trajectory(self) -> Trajectory:
        """All poses, with marginal covariances on the axes of the map."""
        poses = self._graph.poses(self._keys)
        return Trajectory(self.stamps_ns, poses, self._graph.covariances(self._keys, poses))

    def _motion(self, before: int, after: int, delta: FloatArray, covariance: FloatArray) -> gtsam.NonlinearFactor:
        [noise] = noises_of(covariance[None], delta[None, 2])
        huber = gtsam.noiseModel.mEstimator.Huber.Create(self.settings.huber_width)
        robust = noise if np.isinf(self.settings.huber_width) else gtsam.noiseModel.Robust.Create(huber, noise)
        return gtsam.BetweenFactorPose2(before, after, gtsam.Pose2(*delta), robust)

    def _expected(self, place: int, stamp_ns: int) -> FloatArray:
        """The pose (3,) at a stamp, that at a place or between it and the one before."""
        if self._stamps[place] == stamp_ns:
            return self._graph.poses([self._keys[place]])[0]
        before, after = self._graph.poses(self._keys[place - 1 : place + 1])
        return se2.compose(before, se2.exp(self._share(place, stamp_ns) * se2.log(se2.between(before, after))))

    def _share(self, place: int, stamp_ns: int) -> float:
        """Of the time between two poses that has passed at a stamp."""
        start, end = self._stamps[place - 1 : place + 1]
        return (stamp_ns - start) / (end - start)

    def _split(self, place: int, stamp_ns: int, pose: FloatArray) -> None:
        """One more pose between two."""
        key, before, after = len(self._keys), self._keys[place - 1], self._keys[place]
        deltas, spreads = divided(*self._motions[after], self._share(place, stamp_ns))
        factors: dict[Name, gtsam.NonlinearFactor] = {
            ("motion", key): self._motion(before, key, deltas[0], spreads[0]),
            ("motion", after): self._motion(key, after, deltas[1], spreads[1]),
        }
        self._graph.update(factors, {key: pose})
        self._motions[key], self._motions[after] = (deltas[0], spreads[0]), (deltas[1], spreads[1])
        self._stamps.insert(place, stamp_ns)
        self._keys.insert(place, key)

    def _take(self, sites: Mapping[int, KeptSite]) -> None:
        """Measurements with their sites, new or in place of what they were."""
        self._graph.update({("site", key): one.factor(key) for key, one in sites.items()})
        self._sites.update(sites)

    def _newest(self) -> list[int]:
        """Keys of the newest measurements."""
        return list(islice((key for key in reversed(self._keys) if key in self._sites), self.settings.newest))

    def _refresh(self, keys: list[int], most_rounds: int) -> None:
        """Find sites anew whose cavities have moved, until none has."""
        for _ in range(most_rounds if keys else 0):
            poses = self._graph.poses(keys)
            stale = self._sites.stale(keys, poses, self._graph.covariances(keys, poses))
            if not stale:
                break
            self._take(stale)

    def _counted(self, name: str, is_duplicate: bool) -> LagReport:
        self._count(name)
        return LagReport(Outcome.DUPLICATE if is_duplicate else Outcome.TOO_LATE)

    def _count(self, name: str) -> None:
        self.counts = replace(self.counts, **{name: getattr(self.counts, name) + 1})
