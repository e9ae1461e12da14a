"""Tracking on real scans, a real map and real odometry, where the machine has the data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from learned.geometric import GeometricMatcher
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.track_settings import TrackSettings


@pytest.mark.parametrize("seed", [0, 1])
def test_45_m_of_real_lidar_odometry_in_a_real_map(shared_data: Callable[[str], Path], seed: int) -> None:
    sequence = FolderSequence(shared_data("kitti_raw_0013_start"))
    metrics = track(sequence, GeometricMatcher(), TrackSettings("lidar_gicp", seed=seed)).metrics
    mean = {name: metrics[name]["position_error_m"]["mean"] for name in ("prior", "odometry", "filter", "smoother")}
    assert not metrics["scans_simulated"]
    assert not metrics["odometry_emulated"]
    assert mean["filter"] < 1.5
    assert mean["smoother"] < 1.2
    assert metrics["filter_after_first_quarter"]["position_error_m"]["max"] < 2.0
    assert metrics["filter"]["heading_error_deg"]["mean"] < 0.6
    assert metrics["smoother"]["lateral_recall"]["3"] == 1.0
    assert 5.0 * mean["filter"] < min(mean["odometry"], mean["prior"])


def test_840_m_of_real_scans_in_a_real_map(shared_data: Callable[[str], Path]) -> None:
    sequence = FolderSequence(shared_data("kitti360_0009"))
    metrics = track(sequence, GeometricMatcher(), TrackSettings("emulated", seed=0)).metrics
    after = metrics["filter_after_first_quarter"]
    assert metrics["odometry_emulated"]
    assert after["position_error_m"]["mean"] < 1.0
    assert after["heading_error_deg"]["mean"] < 1.0
    assert after["ellipse95"] > 0.75
    assert metrics["drift"]["last_quarter_mean_m"] < 1.0 < 10.0 < metrics["drift"]["odometry_final_error_m"]
