"""A hundred thousand updates of the fixed lag: does memory grow, does a number go bad, does it stay on the way?

    python -m benchmarks.fixed_lag_soak           some minutes of a core
    python -m benchmarks.fixed_lag_soak 5000      fewer updates

Everything is made up: a pose every update, a likelihood with nine in ten of them, of which one in ten late by up to 50
poses, some between poses, some far too late, some twice. A line every twentieth of the way; the exit status is 1 when
something is wrong.
"""

from __future__ import annotations

import resource
import sys
import time
from collections import deque

import numpy as np

from benchmarks.fixed_lag import LAG, truth_at, update_at
from fusion import FixedLagSettings, FixedLagSmoother, GaussianMixture, OdometryIncrement

STEP_NS = 100_000_000
_MOST_SIGMAS = 8.0


def main(updates: int) -> int:
    """Run; the number of things that were wrong."""
    rng, wrong = np.random.default_rng(1), 0
    smoother = FixedLagSmoother(0, np.zeros(3), np.diag([1.0, 1.0, 0.1]) ** 2, FixedLagSettings(lag=LAG))
    waiting: deque[tuple[int, int, GaussianMixture]] = deque()
    memory, slowest, began = 0, 0.0, time.process_time()
    for index in range(1, updates + 1):
        increment, gaussian = update_at(index)
        smoother.add_odometry(OdometryIncrement(index * STEP_NS, increment.delta, increment.covariance))
        kind = rng.random()
        late = 0 if kind < 0.81 else int(rng.integers(1, 50)) if kind < 0.89 else 3 * LAG if kind < 0.9 else -1
        if late >= 0:
            waiting.append((index + late, index, gaussian))
        for _ in range(len(waiting)):
            due, stamp, measured = waiting.popleft()
            if due > index:
                waiting.append((due, stamp, measured))
                continue
            off = -int(rng.integers(1, 1000)) if rng.random() < 0.05 else 0  # a microsecond before its pose
            smoother.add_likelihood(stamp * STEP_NS + off, measured)
            if rng.random() < 0.05:
                smoother.add_likelihood(stamp * STEP_NS + off, measured)
        if index % max(1, updates // 20) == 0:
            estimate = smoother.estimate()
            seconds, began = time.process_time() - began, time.process_time()
            slowest = max(slowest, seconds / max(1, updates // 20))
            off_m = estimate.pose - truth_at(index)
            sigmas = float(np.abs(off_m[:2] / np.sqrt(np.diagonal(estimate.covariance)[:2])).max())
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            bad = len(smoother) > LAG or sigmas > _MOST_SIGMAS or not np.isfinite(estimate.covariance).all()
            wrong += bad + (memory > 0 and peak > memory + 20)
            memory = memory or peak
            print(f"{index}: {1e3 * seconds / max(1, updates // 20):.2f} ms, {peak} MB, {sigmas:.1f} sigma", flush=True)
    print(f"{smoother.counts}, slowest {1e3 * slowest:.2f} ms an update of processor time, {wrong} wrong")
    return wrong


if __name__ == "__main__":
    sys.exit(1 if main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000) else 0)
