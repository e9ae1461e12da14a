"""Tracking on real scans, a real map and real odometry, where the machine has the data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fusion import GaussianLikelihood, MapGrid, Tracker, UniformPrior
from learned.matcher import load_matcher
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.track_settings import TrackSettings


@pytest.mark.parametrize(("matcher", "filter_m", "smoother_m"), [("rotmatch", 0.8, 0.7), ("geometric", 2.2, 1.0)])
def test_45_m_of_real_lidar_odometry_in_a_real_map(
    shared_data: Callable[[str], Path], matcher: str, filter_m: float, smoother_m: float
) -> None:
    sequence = FolderSequence(shared_data("kitti_raw_0013_start"))
    metrics = track(sequence, load_matcher(matcher), TrackSettings("lidar_gicp", seed=1)).metrics
    mean = {name: metrics[name]["position_error_m"]["mean"] for name in ("prior", "odometry", "filter", "smoother")}
    assert not metrics["scans_simulated"]
    assert not metrics["odometry_emulated"]
    assert mean["filter"] < filter_m
    assert mean["smoother"] < smoother_m
    assert metrics["filter"]["heading_error_deg"]["mean"] < 0.6
    assert metrics["smoother"]["lateral_recall"]["3"] == 1.0
    assert 5.0 * mean["filter"] < min(mean["odometry"], mean["prior"])


def test_840_m_of_real_scans_in_a_real_map(shared_data: Callable[[str], Path]) -> None:
    sequence = FolderSequence(shared_data("kitti360_0009"))
    metrics = track(sequence, load_matcher("rotmatch"), TrackSettings("emulated", seed=0)).metrics
    after = metrics["filter_after_first_quarter"]
    assert metrics["odometry_emulated"]
    assert after["position_error_m"]["mean"] < 1.0
    assert after["heading_error_deg"]["mean"] < 1.0
    assert after["ellipse95"] > 0.75
    assert metrics["drift"]["last_quarter_mean_m"] < 1.0 < 10.0 < metrics["drift"]["odometry_final_error_m"]


@pytest.mark.parametrize("estimator", ["filter", "both"])
def test_a_tracker_along_900_m_of_real_odometry_with_late_measurements(
    shared_data: Callable[[str], Path], estimator: str
) -> None:
    """The odometry is S-PTAM's; the likelihoods are emulated, 1 m and 2 degrees wide, and come up to 0.5 s late."""
    sequence = FolderSequence(shared_data("kitti00"))
    odometry, rng = sequence.odometry("sptam"), np.random.default_rng(0)
    assert sequence.ground_truth is not None
    stamps, count = odometry.stamp_ns, 1200
    truth = sequence.ground_truth.interpolate(stamps[:count], 10**8)
    way = np.concatenate([[0.0], np.hypot(*np.diff(truth[:, :2], axis=0).T).cumsum()])
    covariance = np.diag([1.0, 1.0, np.deg2rad(2.0) ** 2])
    arrivals = {}
    for index in np.flatnonzero(np.diff(way // 4.0)) + 1:
        seen, (x, y, _) = rng.multivariate_normal(truth[index], covariance), truth[index]
        likelihood = GaussianLikelihood(seen, covariance, MapGrid(40, 40, 1.0, x - 20.0, y - 20.0))
        arrivals[float(stamps[index] + 5e8 * rng.random())] = int(stamps[index]), likelihood
    tracker = Tracker.from_prior(UniformPrior(truth[0] + [4.0, -3.0, 0.05], 8.0, 0.2), 1000, estimator=estimator)
    errors = []
    for index in range(count):
        tracker.add_odometry(int(stamps[index]), odometry.poses[index])
        for arrival in [time for time in arrivals if time <= stamps[index]]:
            tracker.add_likelihood(*arrivals.pop(arrival))
        errors.append(np.hypot(*(tracker.estimate(max_modes=2).pose - truth[index])[:2]))
    assert way[-1] > 800.0
    assert tracker.statistics.late_likelihoods > 100
    assert max(errors[100:]) < 2.5
    assert np.mean(errors[100:]) < 0.9
