"""Odometry from outside the window: a stray message, or a clock that has jumped?

A stamp far ahead would push everything else out of the window, and a clock that was set back would leave everything
too late for ever. So samples outside the window are looked at together: a run of them, each within a window's length
of the newest in the run and none from inside the window among them, says that this is the clock now.

- Ahead: believed after a number of samples, which are then used. They are withheld until then. Where the run's own
  samples are further apart than the window, the odometry is slow: as long as that lasts its next sample is no stray.
- Behind: each is too late as it comes. Believed when the run is longer than the window and half as dense as the
  odometry in it, which messages that are merely late are not; then the run is used.
"""

from enum import Enum
from itertools import pairwise
from typing import Any, Self

from fusion.tracking.archive import Tree
from fusion.tracking.odometry_buffer import OdometrySample, sample_tree


class Side(Enum):
    """Where a stamp lies against the window."""

    AHEAD = "ahead"
    BEHIND = "behind"


_SLOW_STEPS = 1.5


class ClockGuard:
    """A run of odometry samples outside the window.

    Parameters
    ----------
    history_ns : int
        Length of the window.
    samples : int
        Length of a run ahead that is believed.
    step_ns : int
        Samples ahead that are further apart than this, and than the window, are not of one run.
    """

    def __init__(self, history_ns: int, samples: int, step_ns: int = 0) -> None:
        self._history_ns, self._samples = history_ns, samples
        self._steps_ns = {Side.AHEAD: max(history_ns, step_ns), Side.BEHIND: history_ns}
        self.ahead_ns = history_ns
        """A sample further ahead of the newest than this is outside the window."""
        self._side: Side | None = None
        self._run: list[OdometrySample] = []

    @property
    def withheld(self) -> int:
        """Number of samples ahead that wait for more."""
        return len(self._run) if self._side is Side.AHEAD else 0

    def in_time(self, step_ns: int) -> int:
        """Take note of a sample from inside the window, so long after the newest; ends the run as `clear` does."""
        if 0 < step_ns <= self._history_ns:
            self.ahead_ns = self._history_ns
        return self.clear()

    def clear(self) -> int:
        """End the run and say how many samples were withheld."""
        withheld = self.withheld
        self._side, self._run = None, []
        return withheld

    def add(self, sample: OdometrySample, side: Side) -> int:
        """Go on with the run, or begin a new one; says how many withheld samples that gave up."""
        given_up = 0
        if side is self._side and any(sample.stamp_ns == other.stamp_ns for other in self._run):
            return 0
        newest_ns = max((other.stamp_ns for other in self._run), default=sample.stamp_ns)
        if side is not self._side or abs(sample.stamp_ns - newest_ns) > self._steps_ns[side]:
            given_up = self.clear()
        self._side = side
        self._run.append(sample)
        return given_up

    def believed(self, window_count: int) -> list[OdometrySample]:
        """The run in order of time, ended, when it is long enough for a window of so many samples; else nothing."""
        if self._side is Side.AHEAD:
            is_long = len(self._run) >= self._samples
        else:
            is_dense = len(self._run) > 1 and 2 * len(self._run) >= window_count
            stamps = [sample.stamp_ns for sample in self._run]
            is_long = is_dense and max(stamps) - min(stamps) > self._history_ns
        run = sorted(self._run, key=lambda sample: sample.stamp_ns) if is_long else []
        if is_long:
            widest_ns = max((later.stamp_ns - one.stamp_ns for one, later in pairwise(run)), default=0)
            self.ahead_ns = round(_SLOW_STEPS * widest_ns) if widest_ns > self._history_ns else self._history_ns
            self.clear()
        return run

    def to_tree(self) -> Tree:
        """Everything, for a file."""
        side = None if self._side is None else self._side.value
        return {"side": side, "run": [sample_tree(sample) for sample in self._run], "ahead_ns": self.ahead_ns}

    @classmethod
    def from_tree(cls, tree: Any, history_ns: int, samples: int, step_ns: int = 0) -> Self:
        """The guard that was written."""
        guard = cls(history_ns, samples, step_ns)
        guard._side = None if tree["side"] is None else Side(tree["side"])
        guard.ahead_ns = tree["ahead_ns"]
        guard._run = [OdometrySample(**entry) for entry in tree["run"]]
        return guard
