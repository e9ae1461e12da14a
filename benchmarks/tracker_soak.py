"""A million steps of the tracker: does memory grow, does a number go bad, does it stay on the way?

    python -m benchmarks.tracker_soak            some ten minutes of a core
    python -m benchmarks.tracker_soak 50000      fewer steps

Everything is made up: odometry at 100 Hz, one message in fifty late by up to 0.2 s, a likelihood every second that
arrives 0.1 s late; now and then a duplicate, something far too late, an odometry that starts anew, a gap, a clock
that jumps. A line every twentieth of the way; the exit status is 1 when something is wrong.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from fusion import GaussianLikelihood, MapGrid, Tracker, TrackerSettings, UniformPrior, se2
from fusion.arrays import FloatArray

SECOND = 10**9
GRID = MapGrid(300, 300, 1.0, -150.0, -150.0)
SIGMA = np.array([0.5, 0.5, 0.02])
PARTICLES = 200
MOST_HELD = 600  # two seconds at 100 Hz, and some


def truth_at(seconds: float) -> FloatArray:
    """Position at 10 m/s on a circle of 100 m."""
    return se2.exp(np.array([10.0, 0.0, 0.1]) * (seconds % (20.0 * np.pi)))


class Emulation:
    """Streams with faults; the odometry's scale is 1 % off."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.clock_ns = 0
        self.start = np.zeros(3)
        self.began_s = 0.0

    def odometry(self, seconds: float) -> FloatArray:
        """Pose in the odometry's frame of the day."""
        return se2.compose(self.start, se2.exp(np.array([10.1, 0.0, 0.101]) * (seconds - self.began_s)))

    def step(self, tracker: Tracker, index: int) -> None:
        """Everything that arrives within a hundredth of a second."""
        seconds = index / 100.0
        if index % 7_001 == 7_000:
            self.start, self.began_s = self.rng.normal(0.0, 500.0, 3), seconds  # the odometry starts anew
        if index % 9_001 == 9_000:
            self.clock_ns += int(self.rng.choice([-1, 1])) * 3600 * SECOND
        if index % 3_001 < 150 and index > 3_000:
            return  # a gap
        late = self.rng.uniform(0.0, 0.2) if index % 50 == 0 else 0.0
        if index % 1_000 == 7:
            late = 60.0  # far too late
        when = seconds - late
        stamp = round(when * SECOND) + self.clock_ns
        tracker.add_odometry(stamp, self.odometry(when))
        if index % 500 == 3:
            tracker.add_odometry(stamp, self.odometry(when))  # twice
        if index % 100 == 60:
            measured = seconds - 0.1037
            centre = truth_at(measured) + self.rng.normal(0.0, SIGMA)
            likelihood = GaussianLikelihood(centre, np.diag(SIGMA**2), GRID)
            tracker.add_likelihood(round(measured * SECOND) + self.clock_ns, likelihood)


def main(steps: int) -> int:
    """Run, print, and say whether all was well."""
    prior = UniformPrior(np.zeros(3), 5.0, 0.3)
    tracker = Tracker.from_prior(prior, PARTICLES, TrackerSettings(correlation_length_m=5.0), seed=0)
    emulation, begin, errors, peaks = Emulation(), time.perf_counter(), [], []
    for index in range(steps):
        emulation.step(tracker, index)
        if index % 50 == 0 and tracker.newest_ns is not None:
            estimate = tracker.estimate()
            if not (np.isfinite(estimate.pose).all() and np.linalg.eigvalsh(estimate.covariance)[0] > 0.0):
                print(f"step {index}: {estimate}")
                return 1
            errors.append(float(np.linalg.norm(estimate.pose[:2] - truth_at(index / 100.0)[:2])))
        if (index + 1) % max(1, steps // 20) == 0:
            held = tracker.statistics
            count = held.held_odometry + held.held_likelihoods + held.held_states
            peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
            minutes, median = (time.perf_counter() - begin) / 60.0, float(np.median(errors))
            print(
                f"{index + 1:8d} steps {minutes:6.1f} min   peak memory {peaks[-1]:7.1f} MiB   {count:4d} things held"
                f"   median error {median:.2f} m",
                flush=True,
            )
            if count > MOST_HELD:
                return 1
            errors = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tracker.npz"
        tracker.save(path)
        print(f"file {path.stat().st_size / 1024:.0f} KiB")
    print(tracker.statistics)
    grown = peaks[-1] - peaks[len(peaks) // 4]
    print(f"peak memory grew by {grown:.1f} MiB over the last three quarters")
    return int(grown > 8.0)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000))
