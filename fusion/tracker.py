"""The online tracker: odometry and likelihoods in, in any order of arrival; estimates out, whenever they are wanted.

    tracker = Tracker.from_prior(prior)
    tracker.add_odometry(stamp_ns, pose)
    tracker.add_likelihood(stamp_ns, likelihood)
    tracker.estimate().pose

It has no thread, no clock and no queue of its own accord: everything happens in the caller's calls. What comes late,
but within the history, counts as if it had come in time, bit for bit (`fusion.tracking.timeline`); what comes later
still is counted and dropped. Bad input raises and changes nothing. Odometry that cannot be true is not believed
(`fusion.odometry_limits`, `fusion.tracking.clock_guard`). A tracker can be saved and goes on from the file bit
for bit.
"""

from collections import Counter
from pathlib import Path
from typing import Any, Self

from numpy.typing import ArrayLike

from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.fixed_lag import FixedLagSettings
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement
from fusion.odometry_limits import MotionKind
from fusion.particle_filter import ParticleFilterSettings
from fusion.prior import UniformPrior
from fusion.tracking.archive import Tree, read_archive, write_archive
from fusion.tracking.clock_guard import ClockGuard, Side
from fusion.tracking.estimators import EstimatorName, estimator_like, settings_of
from fusion.tracking.estimators import estimator as make_estimator
from fusion.tracking.likelihood_tree import is_same_likelihood
from fusion.tracking.odometry_buffer import OdometrySample
from fusion.tracking.resumable import ResumableFilter
from fusion.tracking.timeline import Progress, Timeline
from fusion.tracking.tracker_input import (
    check_likelihood,
    checked_increment,
    checked_pose,
    checked_stamp,
    checked_whole,
    one_line,
)
from fusion.tracking.tracker_report import Arrival, Outcome, Statistics
from fusion.tracking.tracker_settings import TrackerSettings, settings_from_tree

_FORMAT, _VERSION = "skyfix tracker", 3


class Tracker:
    """Asynchronous streams around a filter. Not for several threads at once.

    Parameters
    ----------
    pose_filter : ResumableFilter
        At its prior, which holds at the first odometry sample. It belongs to the tracker from here on.
    settings : TrackerSettings
        How streams are treated.
    seed : int
        Non-negative; the same seed and the same messages, whatever their order, give the same estimates.

    Raises
    ------
    SkyfixError
        When the seed is not a whole number >= 0.
    """

    def __init__(self, pose_filter: ResumableFilter, settings: TrackerSettings | None = None, seed: int = 0) -> None:
        self.settings = settings or TrackerSettings()
        self._seed = checked_whole("seed", seed, least=0)
        self._timeline = Timeline(pose_filter, self.settings, self._seed)
        self._guard = ClockGuard(*_guarded(self.settings))
        self._counts: Counter[str] = Counter()
        self._is_increments: bool | None = None

    @classmethod
    def from_prior(
        cls,
        prior: UniformPrior,
        particles: int = 10_000,
        settings: TrackerSettings | None = None,
        filter_settings: ParticleFilterSettings | None = None,
        seed: int = 0,
        estimator: EstimatorName = "filter",
        graph_settings: FixedLagSettings | None = None,
    ) -> Self:
        """A tracker from a prior, which holds at the first odometry sample.

        Parameters
        ----------
        estimator : {"filter", "graph", "both"}
            A particle filter: any prior, finds its place again. A factor graph with a fixed lag: a start known to some
            metres, re-linearised as the estimate moves, cheap, no recovery. Both: the filter finds the place, the graph
            says where exactly, see `fusion.graph_filter`.
        """
        count, seed = checked_whole("particles", particles, least=1), checked_whole("seed", seed, least=0)
        return cls(make_estimator(estimator, prior, count, seed, filter_settings, graph_settings), settings, seed)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry in use."""
        return self._timeline.newest_ns

    @property
    def statistics(self) -> Statistics:
        """Counts so far, and what is in memory."""
        kinds, waiting = self._timeline.odometry.kind_counts, len(self._timeline.waiting())
        return Statistics(
            **self._counts,
            gaps=kinds[MotionKind.GAP],
            resets=kinds[MotionKind.RESET],
            clock_jumps=kinds[MotionKind.CLOCK_JUMP],
            held_odometry=len(self._timeline.odometry) + self._guard.withheld,
            held_likelihoods=len(self._timeline.likelihoods),
            held_states=len(self._timeline.history),
            waiting=waiting,
            withheld=self._guard.withheld,
        )

    def add_odometry(self, stamp_ns: int, pose: ArrayLike) -> Arrival:
        """Take in a pose (3,) of a drifting odometry, in any fixed frame.

        Raises
        ------
        SkyfixError
            When the stamp is not an int64, the pose is not three finite numbers, or increments came before.
            What the filter itself raises comes through; the tracker is then as before, without the odometry since the
            last step if the filter cannot take that either.
        """
        return self._take_odometry(checked_pose(stamp_ns, pose), is_increment=False)

    def add_increment(self, increment: OdometryIncrement) -> Arrival:
        """Take in the motion since the odometry's previous increment, in place of poses.

        Raises
        ------
        SkyfixError
            When it is not an increment, its stamp is not an int64, its values are out of all reason, or poses came
            before.
        """
        return self._take_odometry(checked_increment(increment), is_increment=True)

    def add_likelihood(self, stamp_ns: int, likelihood: PoseLikelihood) -> Arrival:
        """Take in a measurement; it is used at once, or as soon as odometry covers its stamp.

        It is flattened by the tracker for errors that it shares with the measurement before, by the distance driven.

        Raises
        ------
        SkyfixError
            When the stamp is not an int64, or the likelihood is none or gives NaN.
        """
        stamp_ns = checked_stamp(stamp_ns)
        check_likelihood(likelihood)
        if stamp_ns <= self._timeline.horizon_ns:
            self._counts["too_late_likelihoods"] += 1
            return Arrival(stamp_ns, Outcome.TOO_LATE)
        existing = self._timeline.likelihoods.get(stamp_ns)
        if existing is not None:
            return self._repeated(stamp_ns, is_same_likelihood(existing, likelihood))
        with self._timeline.unchanged_by_errors():
            progress = self._timeline.add_likelihood(stamp_ns, likelihood)
        refusal = progress.refused.pop(stamp_ns, None)
        self._counts["rejected_likelihoods"] += len(progress.refused)
        if refusal is not None:
            raise one_line(refusal, stamp_ns) from refusal
        self._counts["likelihoods"] += 1
        self._counts["late_likelihoods"] += progress.replayed > 0
        waiting = self._timeline.waiting()
        overflow = waiting[: max(0, len(waiting) - self.settings.max_waiting)]
        for stamp in overflow:
            self._timeline.likelihoods.remove(stamp)
        self._counts["overflowed_likelihoods"] += len(overflow)
        outcome = Outcome.WAITING if stamp_ns in waiting else Outcome.USED
        return self._arrival(stamp_ns, outcome, [progress], overflow)

    def estimate(self, stamp_ns: int | None = None, max_modes: int = 0) -> Estimate:
        """The pose at a time from all that has a stamp up to then; asking changes nothing.

        Parameters
        ----------
        stamp_ns : int, optional
            Within the history or later; the newest odometry when left out. Beyond the newest odometry the last
            turn is held for `OdometryLimits.gap_s` and the last speed for `clock_jump_s`, and the covariance grows like
            that of a vehicle whose acceleration nobody knows.
        max_modes : int
            Heaviest clusters to be told, if not 0.

        Raises
        ------
        SkyfixError
            When there is no odometry yet, the time is before the history, or `max_modes` is no whole number >= 0.
        """
        max_modes = checked_whole("max_modes", max_modes, least=0)
        newest_ns = self._timeline.newest_ns
        if newest_ns is None:
            raise SkyfixError("estimate: expected odometry before it, got none")
        return self._timeline.estimate(newest_ns if stamp_ns is None else checked_stamp(stamp_ns), max_modes)

    def save(self, path: str | Path) -> None:
        """Write everything to a file, npz with JSON inside, from which `load` goes on bit for bit.

        Raises
        ------
        SkyfixError
            When the file cannot be written, or a likelihood held is of a type that skyfix does not know.
        """
        pose_filter = self._timeline.filter
        tree: dict[str, Tree] = {
            "format": _FORMAT,
            "version": _VERSION,
            "settings": self.settings.to_tree(),
            "seed": self._seed,
            "filter": type(pose_filter).__name__,
            "filter_settings": settings_of(pose_filter),
            "is_increments": self._is_increments,
            "guard": self._guard.to_tree(),
            "counts": dict(self._counts),
            **self._timeline.to_tree(),
        }
        write_archive(path, tree)

    @classmethod
    def load(cls, path: str | Path, pose_filter: ResumableFilter | None = None) -> Self:
        """The tracker that was saved.

        Parameters
        ----------
        path : str or Path
            The file.
        pose_filter : ResumableFilter, optional
            A filter with the settings of the one that was saved, in any state; needed if that was of a type of the
            caller's own.

        Raises
        ------
        SkyfixError
            When the file is missing, damaged or of another version, or the filter is of another type.
        """
        tree = read_archive(path)
        try:
            return cls._from_tree(path, tree, pose_filter)
        except SkyfixError:
            raise
        except Exception as error:
            raise SkyfixError(f"{path}: expected a saved tracker, got one with parts missing or damaged") from error

    @classmethod
    def _from_tree(cls, path: str | Path, tree: Any, pose_filter: ResumableFilter | None) -> Self:
        if not isinstance(tree, dict) or (tree.get("format"), tree.get("version")) != (_FORMAT, _VERSION):
            raise SkyfixError(f"{path}: expected a saved tracker of version {_VERSION}, got something else")
        if pose_filter is None and tree["filter_settings"] is not None:
            pose_filter = estimator_like(tree["filter"], tree["filter_settings"])
        if pose_filter is None or type(pose_filter).__name__ != tree["filter"]:
            given = "none" if pose_filter is None else type(pose_filter).__name__
            raise SkyfixError(f"{path}: expected a {tree['filter']} to put the state into, got {given}")
        settings = settings_from_tree(tree["settings"])
        tracker = cls(pose_filter, settings, tree["seed"])
        tracker._timeline.resume(tree)
        tracker._guard = ClockGuard.from_tree(tree["guard"], *_guarded(settings))
        tracker._counts = Counter(tree["counts"])
        tracker._is_increments = tree["is_increments"]
        return tracker

    def _take_odometry(self, sample: OdometrySample, is_increment: bool) -> Arrival:
        if self._is_increments is (not is_increment):
            kinds = ("increments", "poses") if is_increment else ("poses", "increments")
            raise SkyfixError(f"odometry: expected {kinds[1]} as before, got {kinds[0]}")
        counts, withheld = self._counts.copy(), self._guard.withheld
        try:
            with self._timeline.unchanged_by_errors():
                arrival = self._placed(sample)
        except BaseException:
            counts["dismissed_odometry"] += withheld - self._guard.withheld + self._timeline.give_up_unusable()
            self._counts = counts
            raise
        self._is_increments = is_increment
        return arrival

    def _placed(self, sample: OdometrySample) -> Arrival:
        newest_ns = self._timeline.newest_ns
        step_ns = 0 if newest_ns is None else sample.stamp_ns - newest_ns
        if step_ns > self._guard.ahead_ns:
            return self._take_outside(sample, Side.AHEAD)
        if sample.stamp_ns <= self._timeline.horizon_ns:
            return self._take_outside(sample, Side.BEHIND)
        existing = self._timeline.odometry.get(sample.stamp_ns)
        if existing is not None:
            arrival = self._repeated(sample.stamp_ns, existing.same_as(sample))
        else:
            arrival = self._use_odometry([sample], [])
        self._counts["dismissed_odometry"] += self._guard.in_time(step_ns)
        return arrival

    def _take_outside(self, sample: OdometrySample, side: Side) -> Arrival:
        """A sample from outside the window: alone it is nothing, in a long enough run it is a clock that jumped."""
        self._counts["dismissed_odometry"] += self._guard.add(sample, side)
        self._counts["too_late_odometry"] += side is Side.BEHIND
        run = self._guard.believed(len(self._timeline.odometry))
        if not run:
            return Arrival(sample.stamp_ns, Outcome.TOO_LATE if side is Side.BEHIND else Outcome.WITHHELD)
        lost: list[int] = []
        if side is Side.BEHIND:
            self._counts["too_late_odometry"] -= len(run)
            lost = self._timeline.set_back()
        return self._use_odometry(run, lost)

    def _use_odometry(self, samples: list[OdometrySample], lost: list[int]) -> Arrival:
        steps = []
        for sample in samples:
            newest_ns = self._timeline.newest_ns
            self._counts["late_odometry"] += newest_ns is not None and sample.stamp_ns < newest_ns
            steps.append(self._timeline.add_odometry(sample))
            self._counts["odometry"] += 1
            self._counts["rejected_likelihoods"] += len(steps[-1].refused)
        lost = lost + self._timeline.forget()
        self._counts["uncovered_likelihoods"] += len(lost)
        return self._arrival(samples[-1].stamp_ns, Outcome.USED, steps, lost)

    def _repeated(self, stamp_ns: int, is_same: bool) -> Arrival:
        self._counts["duplicates" if is_same else "conflicts"] += 1
        return Arrival(stamp_ns, Outcome.DUPLICATE if is_same else Outcome.CONFLICT)

    def _arrival(self, stamp_ns: int, outcome: Outcome, steps: list[Progress], lost: list[int]) -> Arrival:
        replayed = sum(step.replayed for step in steps)
        self._counts["replayed_steps"] += replayed
        measured = tuple(one for step in steps for one in step.measured)
        refused = [stamp for step in steps for stamp in step.refused]
        return Arrival(stamp_ns, outcome, measured, replayed, (*lost, *refused))


def _guarded(settings: TrackerSettings) -> tuple[int, int, int]:
    """The window, the run and the step of a `ClockGuard`; slow odometry is no clock that jumps."""
    return settings.history_ns, settings.clock_samples, round(1e9 * settings.limits.clock_jump_s)
