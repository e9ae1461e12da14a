"""The filter along time: a function of what has arrived, not of the order in which it arrived.

The filter is moved from node to node, the nodes being the stamps of the likelihoods and one odometry sample in every
step. Odometry and likelihoods are held in order of their stamps, and before each node the filter is reseeded by the
seed and the node's stamp. When something late comes in, the nodes after it are taken back and done again from the
snapshot before it, with the result that it would have had in time.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import log
from typing import Any

import numpy as np

from fusion.consistency import error_correlation
from fusion.error_memory import ErrorMemory
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement, accumulate
from fusion.pose_filter import UpdateReport
from fusion.tracking.archive import Tree
from fusion.tracking.history import History, Node, history_from_tree
from fusion.tracking.likelihood_buffer import LikelihoodBuffer
from fusion.tracking.odometry_buffer import BEGINNING, OdometryBuffer, OdometrySample
from fusion.tracking.resumable import ResumableFilter
from fusion.tracking.tracker_report import Measured
from fusion.tracking.tracker_settings import TrackerSettings

_NODE_STREAM, _FORWARD_STREAM = 0, 1


@dataclass(slots=True)
class Progress:
    """What moving on came to: measurements done, steps done again, likelihoods refused with the reason."""

    measured: list[Measured] = field(default_factory=list)
    replayed: int = 0
    refused: dict[int, Exception] = field(default_factory=dict)


class Timeline:
    """A filter, what it has been given, and its snapshots.

    Parameters
    ----------
    pose_filter : ResumableFilter
        Always in the state of the history's head.
    settings : TrackerSettings
        Steps, correlation of errors, what odometry can be believed.
    seed : int
        Source of all randomness, non-negative.
    """

    def __init__(self, pose_filter: ResumableFilter, settings: TrackerSettings, seed: int) -> None:
        self.filter = pose_filter
        self.odometry = OdometryBuffer(settings.noise, settings.limits)
        self.likelihoods = LikelihoodBuffer()
        self.history = History([Node(BEGINNING, pose_filter.state(), None)])
        self._settings, self._seed = settings, seed

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry."""
        return self.odometry.newest.stamp_ns if len(self.odometry) else None

    @property
    def horizon_ns(self) -> int:
        """What has this stamp or an older one comes too late."""
        return BEGINNING if self.newest_ns is None else max(BEGINNING, self.newest_ns - self._settings.history_ns)

    @contextmanager
    def unchanged_by_errors(self) -> Iterator[None]:
        """What is done to the timeline within and then raises has not been done."""
        kept = self.odometry.copy(), self.likelihoods.copy(), self.history.copy()
        try:
            yield
        except BaseException:
            self.odometry, self.likelihoods, self.history = kept
            self.filter.restore(self.history.head.state)
            raise

    def give_up_unusable(self) -> int:
        """Drop the odometry that waits for the next step if the filter cannot take it; says how many samples."""
        head, newest_ns = self.history.head, self.newest_ns
        if newest_ns is None or newest_ns <= head.stamp_ns:
            return 0
        try:
            self._move(head, newest_ns, newest_ns)
            self.filter.state()
        except Exception:
            return self.odometry.forget_after(head.stamp_ns)
        finally:
            self.filter.restore(head.state)
        return 0

    def add_odometry(self, sample: OdometrySample) -> Progress:
        """Take in a sample with a new stamp after the horizon."""
        return self._again(self.odometry.insert(sample))

    def add_likelihood(self, stamp_ns: int, likelihood: PoseLikelihood) -> Progress:
        """Take in a likelihood with a new stamp after the horizon."""
        self.likelihoods.add(stamp_ns, likelihood)
        return self._again(stamp_ns - 1) if self.odometry.covers(stamp_ns) else Progress()

    def waiting(self) -> list[int]:
        """Stamps of the likelihoods that odometry does not cover, in order of arrival."""
        if len(self.odometry) == 0:
            return self.likelihoods.outside(BEGINNING, BEGINNING)
        first_ns = self.odometry.first_ns if self.history.base.stamp_ns == BEGINNING else BEGINNING
        return self.likelihoods.outside(first_ns, self.odometry.newest.stamp_ns)

    def forget(self) -> list[int]:
        """Drop what no late message can need any more; says which likelihoods were never covered by odometry."""
        floor_ns = self.odometry.at_or_before(self.horizon_ns)
        uncovered = [stamp for stamp in self.waiting() if stamp <= self.horizon_ns]
        for stamp in uncovered:
            self.likelihoods.remove(stamp)
        if floor_ns is not None:
            self.history.forget_before(floor_ns)
            self.odometry.forget_before(self.history.base.stamp_ns)
            self.likelihoods.forget_until(self.history.base.stamp_ns)
        return uncovered

    def set_back(self) -> list[int]:
        """Begin anew, from the filter at the newest odometry, on a clock that was set back.

        Says which likelihoods waited for odometry that will not come.
        """
        waiting = self.waiting()
        head, newest = self.history.head, self.odometry.newest
        distance = head.distance_m
        if newest.stamp_ns > head.stamp_ns:
            distance = self._move(head, newest.stamp_ns, newest.stamp_ns)
        entries = self.odometry.kind_counts
        self.odometry = OdometryBuffer(self._settings.noise, self._settings.limits, newest)
        self.odometry.kind_counts = entries
        self.likelihoods = LikelihoodBuffer()
        self.history = History([Node(BEGINNING, self.filter.state(), distance, head.memory)])
        return waiting

    def estimate(self, stamp_ns: int, max_modes: int) -> Estimate:
        """The filter's answer at a time, from all that has a stamp up to then.

        Raises
        ------
        SkyfixError
            When the time is before the history or the first odometry; there must be odometry.
        """
        node = self.history.at_or_before(stamp_ns)
        if node is None or stamp_ns < self.odometry.first_ns:
            first_ns = max(self.history.base.stamp_ns, self.odometry.first_ns)
            raise SkyfixError(f"estimate: expected a stamp from {first_ns} ns on, got {stamp_ns}")
        head = self.history.head
        if node is head and stamp_ns == head.stamp_ns:
            return self.filter.estimate(stamp_ns, max_modes)
        try:
            self.filter.restore(node.state)
            self._move(node, stamp_ns, node.stamp_ns, _FORWARD_STREAM)
            return self.filter.estimate(stamp_ns, max_modes)
        finally:
            self.filter.restore(head.state)

    def to_tree(self) -> dict[str, Tree]:
        """Everything but the settings and the seed, for a file."""
        return {
            "odometry": self.odometry.to_tree(),
            "likelihoods": self.likelihoods.to_tree(),
            "history": self.history.to_tree(),
        }

    def resume(self, tree: Any) -> None:
        """Go on from what was written by a timeline with the same settings, seed and kind of filter."""
        self.odometry = OdometryBuffer.from_tree(tree["odometry"], self._settings.noise, self._settings.limits)
        self.likelihoods = LikelihoodBuffer.from_tree(tree["likelihoods"])
        self.history = history_from_tree(tree["history"], type(self.filter.state()))
        self.filter.restore(self.history.head.state)

    def _again(self, after_ns: int) -> Progress:
        """Do all nodes after a stamp, which is not before the base's, again, and those that are new."""
        progress = Progress(replayed=self.history.take_back(after_ns))
        if progress.replayed:
            self.filter.restore(self.history.head.state)
        for stamp_ns in self._nodes():
            head = self.history.head
            try:
                self.history.append(self._node(head, stamp_ns, progress))
            except Exception as error:
                self.filter.restore(head.state)
                if self.likelihoods.get(stamp_ns) is None:
                    raise
                self.likelihoods.remove(stamp_ns)
                progress.refused[stamp_ns] = error
        return progress

    def _nodes(self) -> Iterator[int]:
        """Stamps of the nodes after the head, as the head moves on."""
        while len(self.odometry):
            head_ns = self.history.head.stamp_ns
            step = self.odometry.next_step(head_ns, self._settings.step_ns)
            likelihood = self.likelihoods.next_after(max(head_ns, self.odometry.first_ns - 1))
            covered = [likelihood] if likelihood is not None and self.odometry.covers(likelihood) else []
            due = covered if step is None else [step, *covered]
            if not due:
                return
            yield min(due)

    def _node(self, head: Node, stamp_ns: int, progress: Progress) -> Node:
        distance = self._move(head, stamp_ns, stamp_ns)
        likelihood, memory = self.likelihoods.get(stamp_ns), head.memory
        if likelihood is not None:
            measured, memory = self._weigh(stamp_ns, likelihood, distance, memory)
            progress.measured.append(measured)
            distance = 0.0 if measured.update.used else distance
        return Node(stamp_ns, self.filter.state(), distance, memory)

    def _weigh(
        self, stamp_ns: int, likelihood: PoseLikelihood, distance: float | None, memory: ErrorMemory
    ) -> tuple[Measured, ErrorMemory]:
        """Weigh the filter; errors that this measurement repeats are flattened for."""
        length = self._settings.correlation_length_m
        if length == 0.0:
            return _measured(stamp_ns, 1.0, self.filter.update(likelihood), likelihood), memory
        correlation = 0.0 if distance is None else error_correlation(distance, length)
        before = self.filter.estimate(stamp_ns).covariance
        temperature = memory.temperature(correlation, before)
        update = self.filter.update(likelihood, temperature)
        if update.used:
            memory = memory.after(correlation, temperature, before, self.filter.estimate(stamp_ns).covariance)
        return _measured(stamp_ns, temperature, update, likelihood), memory

    def _move(self, node: Node, stamp_ns: int, key_ns: int, stream: int = _NODE_STREAM) -> float | None:
        """Reseed the filter and move it from a node to a stamp; the distance since the last measurement then."""
        words = np.random.SeedSequence([self._seed, key_ns % 2**64, stream]).generate_state(1, np.uint64)
        self.filter.reseed(int(words[0]))
        motion = self._motion(node.stamp_ns, stamp_ns)
        if motion is None:
            return node.distance_m
        self.filter.predict(motion)
        return None if node.distance_m is None else node.distance_m + float(np.hypot(*motion.delta[:2]))

    def _motion(self, start_ns: int, stamp_ns: int) -> OdometryIncrement | None:
        """From a node's stamp, or from the beginning, to a stamp: within the odometry, then beyond it."""
        pieces = []
        entry = self.odometry.entry_motion() if start_ns == BEGINNING else None
        start_ns = max(start_ns, self.odometry.first_ns)
        covered_ns = min(stamp_ns, self.odometry.newest.stamp_ns)
        if entry is not None:
            pieces.append(entry)
        if covered_ns > start_ns:
            pieces.append(self.odometry.motion(start_ns, covered_ns))
        if stamp_ns > covered_ns:
            pieces.append(self.odometry.extrapolated(stamp_ns))
        return accumulate(pieces) if pieces else None


def _measured(stamp_ns: int, temperature: float, update: UpdateReport, likelihood: PoseLikelihood) -> Measured:
    return Measured(stamp_ns, temperature, update, update.log_evidence + log(likelihood.searched_volume))
