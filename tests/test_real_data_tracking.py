"""Tracking on real scans, a real map and real odometry, where the machine has the data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

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
