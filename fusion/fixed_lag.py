"""The factor graph online: the newest poses of a drive smoothed with every message, at a cost that does not grow.

    smoother = FixedLagSmoother.from_prior(stamp_ns, prior)
    smoother.add_odometry(increment)
    smoother.add_likelihood(stamp_ns, likelihood)
    smoother.estimate().pose
    smoother.trajectory()

Every increment of the odometry brings a pose. A likelihood goes on the pose with its stamp; between two poses the
odometry is divided there. Whole likelihoods count as they do in `fusion.factor_graph.smooth`: each stands in the graph
as the Gaussian that has its effect, found anew as the estimate moves (`fusion.graph.lag_rounds`), and with a lag longer
than the drive the two agree. Poses beyond the lag are summed over; what they say is the prior of the oldest pose that
stays, linearised where it was then.

The window's chain is solved by one compiled pass in place of GTSAM's calls, with GTSAM's factors and to the same
answer (`fusion.graph.chain_solver`).

A likelihood that comes late counts in full while its time is inside the window, as it would have in time but for where
the poses that have left were linearised; one that comes later still, or again, is counted and changes nothing. Odometry
must come in order: a motion that went missing must be in the next increment. `Tracker` puts streams in order.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from fusion.arrays import FloatArray, checked
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.lag_rounds import refreshed, seen_at
from fusion.graph.lag_settings import FixedLagSettings
from fusion.graph.lag_window import LagWindow, first_window, kept_measurement
from fusion.graph.measurements import Measurement
from fusion.graph.patch import LikelihoodPatch
from fusion.graph.sites import Sites
from fusion.odometry import OdometryIncrement
from fusion.prior import UniformPrior
from fusion.tracking.tracker_input import check_likelihood, checked_increment, checked_stamp, one_line
from fusion.tracking.tracker_report import Outcome
from fusion.trajectory import Trajectory

__all__ = ["FixedLagSettings", "FixedLagSmoother", "LagCounts", "LagReport", "LagState"]


@dataclass(frozen=True, slots=True)
class LagReport:
    """What one message did.

    Parameters
    ----------
    outcome : Outcome
        USED, DUPLICATE or TOO_LATE.
    log_evidence : float
        ln density per m^2 rad of a likelihood given all messages used before it, normalised; 0 of anything else.
    """

    outcome: Outcome
    log_evidence: float = 0.0


@dataclass(frozen=True, slots=True)
class LagCounts:
    """Messages so far.

    Parameters
    ----------
    odometry, likelihoods : int
        Used.
    late_likelihoods : int
        Of these, how many came after one with a newer stamp.
    late_odometry, too_late_likelihoods, duplicates : int
        Refused: increments out of order, likelihoods from before the window, stamps that were there already.
    """

    odometry: int = 0
    likelihoods: int = 0
    late_likelihoods: int = 0
    late_odometry: int = 0
    too_late_likelihoods: int = 0
    duplicates: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class LagState:
    """All that a smoother knows; it never changes.

    Parameters
    ----------
    window : LagWindow
        Poses and factors.
    log_evidence, last_log_evidence : float
        ln density of all likelihoods used, and of the last to come, given those before.
    counts : LagCounts
        Messages.
    """

    window: LagWindow
    log_evidence: float = 0.0
    last_log_evidence: float = 0.0
    counts: LagCounts = LagCounts()


class FixedLagSmoother:
    """The newest poses of a drive.

    Parameters
    ----------
    stamp_ns : int
        Of the first pose.
    mean : (3,) array_like
        ``[x, y, yaw]``, map frame.
    covariance : (3, 3) array_like
        Of the first pose on the axes of the map, positive definite.
    settings : FixedLagSettings
        How the smoother behaves.

    Raises
    ------
    SkyfixError
        When the stamp is not an int64, a value is not finite, or the covariance is not positive definite.
    """

    def __init__(
        self, stamp_ns: int, mean: ArrayLike, covariance: ArrayLike, settings: FixedLagSettings | None = None
    ) -> None:
        start = GaussianMixture(
            np.ones(1), checked("mean", mean, (3,))[None], checked("covariance", covariance, (3, 3))[None]
        )
        self.settings = settings or FixedLagSettings()
        self._state = LagState(first_window(checked_stamp(stamp_ns), start.means[0], start.covariances[0]))

    @classmethod
    def from_prior(cls, stamp_ns: int, prior: UniformPrior, settings: FixedLagSettings | None = None) -> Self:
        """A smoother that begins with the mean and covariance of a prior's box."""
        return cls(stamp_ns, prior.mean, prior.covariance, settings)

    @classmethod
    def from_state(cls, state: LagState, settings: FixedLagSettings | None = None) -> Self:
        """A smoother that goes on from a state."""
        smoother = cls(0, np.zeros(3), np.eye(3), settings)
        smoother.restore(state)
        return smoother

    def __len__(self) -> int:
        """Number of poses held."""
        return len(self._state.window)

    @property
    def counts(self) -> LagCounts:
        """Messages so far."""
        return self._state.counts

    @property
    def log_evidence(self) -> float:
        """ln density of all likelihoods used, each given those before it."""
        return self._state.log_evidence

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the oldest and the newest pose held."""
        stamps = self._state.window.stamps
        return int(stamps[0]), int(stamps[-1])

    def state(self) -> LagState:
        """All that the smoother knows, to go back to."""
        return self._state

    def restore(self, state: LagState) -> None:
        """Go back to a state."""
        self._state = state

    def prediction(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Pose (3,) and covariance (3, 3) at the pose held that is nearest after a stamp, the newest at most."""
        window = self._state.window
        place = min(int(np.searchsorted(window.stamps, stamp_ns)), len(window) - 1)
        return window.poses[place], window.covariances[place]

    def add_odometry(self, increment: OdometryIncrement) -> LagReport:
        """Add a pose by the motion from the newest.

        Raises
        ------
        SkyfixError
            When it is not an increment, its stamp is not an int64, or its values are out of all reason.
        """
        stamp_ns = checked_increment(increment).stamp_ns
        window = self._state.window
        if stamp_ns <= window.stamps[-1]:
            held = bool((window.stamps == stamp_ns).any())
            self._count("duplicates" if held else "late_odometry")
            return LagReport(Outcome.DUPLICATE if held else Outcome.TOO_LATE)
        grown = window.extended(increment).shortened(self.settings.lag, self.settings.huber_width)
        if not (np.isfinite(grown.poses[-1]).all() and np.isfinite(grown.covariances[-1]).all()):
            raise SkyfixError("fixed lag: expected a finite prediction, got NaN or an infinity")
        self._state = replace(self._state, window=grown)
        self._count("odometry")
        return LagReport(Outcome.USED)

    def add_likelihood(self, stamp_ns: int, likelihood: Measurement) -> LagReport:
        """Add a measurement anywhere inside the window and smooth.

        Parameters
        ----------
        stamp_ns : int
            From the oldest to the newest pose held.
        likelihood : PoseLikelihood, LikelihoodPatch or GaussianMixture
            Tempered for errors that are correlated in time. An outlier probability of its own counts beside the
            settings'.

        Raises
        ------
        SkyfixError
            When the stamp is no int64 or lies beyond the newest pose, the likelihood is none or gives NaN, or nothing
            finite comes of it; the smoother is then as it was.
        """
        stamp_ns = checked_stamp(stamp_ns)
        if not isinstance(likelihood, (GaussianLikelihood, GaussianMixture, LikelihoodPatch)):
            check_likelihood(likelihood)
        window, settings = self._state.window, self.settings
        if stamp_ns > window.stamps[-1]:
            raise SkyfixError(f"likelihood: expected a stamp up to the odometry's {window.stamps[-1]}, got {stamp_ns}")
        if stamp_ns < window.stamps[0]:
            self._count("too_late_likelihoods")
            return LagReport(Outcome.TOO_LATE)
        place = int(np.searchsorted(window.stamps, stamp_ns))
        exists = window.stamps[place] == stamp_ns
        if exists and window.measurements[place] is not None:
            self._count("duplicates")
            return LagReport(Outcome.DUPLICATE)
        late = any(one is not None for one in window.measurements[place:])
        try:
            if not exists:
                window = window.split(stamp_ns).solved(settings.huber_width)
            kept = kept_measurement(likelihood, window.poses[place], window.covariances[place])
            window, log_evidence = self._weighed(window.with_measurement(place, kept), place)
            window = self._settled(window).shortened(settings.lag, settings.huber_width)
        except SkyfixError:
            raise
        except Exception as error:
            raise one_line(error, stamp_ns) from error
        self._state = replace(
            self._state,
            window=window,
            log_evidence=self._state.log_evidence + log_evidence,
            last_log_evidence=log_evidence,
        )
        self._count("likelihoods")
        if late:
            self._count("late_likelihoods")
        return LagReport(Outcome.USED, log_evidence)

    def estimate(self, max_modes: int = 0) -> Estimate:
        """The newest pose; as its only mode too when `max_modes` is not 0. A graph has no model of being lost."""
        window = self._state.window
        pose, covariance = window.poses[-1].copy(), window.covariances[-1].copy()
        modes = GaussianMixture(np.ones(1), pose[None], covariance[None]) if max_modes else None
        return Estimate(int(window.stamps[-1]), pose, covariance, modes, 1.0, self._state.last_log_evidence, 0.0)

    def trajectory(self) -> Trajectory:
        """All poses held, with marginal covariances on the axes of the map."""
        window = self._state.window
        return Trajectory(window.stamps, window.poses, window.covariances)

    def _weighed(self, window: LagWindow, place: int) -> tuple[LagWindow, float]:
        """The first site of a measurement under its prediction, and its evidence."""
        places = np.array([place])
        centres, widths = window.poses[places], window.covariances[places]
        found = seen_at(
            window, places, centres, widths, self.settings.outlier_probability, self.settings.clutter_log_density
        )
        sites = Sites(centres, *found.factors())
        return window.with_sites(places, sites, centres, widths), float(found.log_mass[0])

    def _settled(self, window: LagWindow) -> LagWindow:
        settings = self.settings
        window = window.solved(settings.huber_width)
        for _ in range(settings.rounds):
            window, count = refreshed(
                window, settings.refreshes, settings.outlier_probability, settings.clutter_log_density
            )
            if count == 0:
                break
            window = window.solved(settings.huber_width)
        return window

    def _count(self, name: str) -> None:
        counts = replace(self._state.counts, **{name: getattr(self._state.counts, name) + 1})
        self._state = replace(self._state, counts=counts)
