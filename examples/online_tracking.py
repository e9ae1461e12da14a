"""Track a vehicle online: odometry at 100 Hz, map likelihoods at 2 Hz that arrive 0.3 s late.

Everything here is emulated: the vehicle, an odometry that drifts, and Gaussians in place of a network's likelihoods.

    python examples/online_tracking.py
"""

from __future__ import annotations

from collections import deque

import numpy as np

from fusion import GaussianLikelihood, MapGrid, Tracker, TrackerSettings, UniformPrior, se2

SECONDS, ODOMETRY_HZ, MEASURE_EVERY, LATE = 20, 100, 50, 30  # the last two in odometry samples
SECOND = 10**9
MAP = MapGrid(400, 400, 1.0, -200.0, -200.0)
SIGMA = np.array([0.8, 0.8, 0.02])


def main() -> None:
    """Drive, and say every two seconds how far off the tracker and the odometry alone are."""
    rng = np.random.default_rng(0)
    prior = UniformPrior(np.zeros(3), half_extent_m=10.0, half_heading_rad=0.5)
    tracker = Tracker.from_prior(prior, 2_000, TrackerSettings(correlation_length_m=5.0), seed=0)

    truth, odometry = np.zeros(3), np.zeros(3)
    under_way: deque[tuple[int, int, GaussianLikelihood]] = deque()  # due at, stamp, likelihood
    print("emulated drive, 10 m/s on a circle   tracker off by   sigma   odometry off by   lost")
    for sample in range(SECONDS * ODOMETRY_HZ + 1):
        stamp_ns = sample * SECOND // ODOMETRY_HZ
        if sample:
            step = np.array([10.0, 0.0, 0.1]) / ODOMETRY_HZ
            truth = se2.compose(truth, se2.exp(step))
            odometry = se2.compose(odometry, se2.exp(step * [1.02, 1.0, 1.05] + rng.normal(0.0, [1e-3, 1e-3, 2e-4])))

        tracker.add_odometry(stamp_ns, odometry)
        if sample % MEASURE_EVERY == 0:
            measured = GaussianLikelihood(truth + rng.normal(0.0, SIGMA), np.diag(SIGMA**2), MAP)
            under_way.append((sample + LATE, stamp_ns, measured))
        while under_way and under_way[0][0] <= sample:
            _, measured_ns, likelihood = under_way.popleft()
            tracker.add_likelihood(measured_ns, likelihood)

        if sample and sample % (2 * ODOMETRY_HZ) == 0:
            estimate = tracker.estimate()
            off = np.linalg.norm(estimate.pose[:2] - truth[:2])
            sigma = np.sqrt(np.trace(estimate.covariance[:2, :2]))
            alone = np.linalg.norm(odometry[:2] - truth[:2])
            seconds = stamp_ns / SECOND
            print(f"{seconds:6.1f} s {off:34.2f} m {sigma:5.2f} m {alone:15.2f} m {estimate.lost_score:6.3f}")

    said = tracker.statistics
    print(
        f"emulated: {said.odometry} odometry messages, {said.likelihoods} likelihoods, {said.late_likelihoods} of them"
        f" late and replayed; in memory {said.held_odometry} odometry messages and {said.held_states} states"
    )


if __name__ == "__main__":
    main()
