"""Emulated runs: fusing beats every measurement and the odometry, on a made-up drive and on a real one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sequences.emulated_run
from fusion import (
    ORIENTERNET_KITTI_SEQUENTIAL,
    EmulatorSettings,
    ParticleSmootherSettings,
    SkyfixError,
    Trajectory,
    se2,
)
from fusion.odometry_errors import OdometryCalibration
from sequences.emulated_odometry import emulate_odometry
from sequences.emulated_run import EmulatedRunSettings, run_emulated
from sequences.folder import FolderSequence

QUICK = ParticleSmootherSettings(paths=100)


def winding_drive(frames: int) -> Trajectory:
    poses = [np.array([50.0, 20.0, 0.4])]
    for frame in range(1, frames):
        poses.append(se2.compose(poses[-1], np.array([1.0, 0.0, 0.04 * np.sin(0.02 * frame)])))
    return Trajectory(np.arange(frames) * 100_000_000, np.array(poses))


def test_fusing_emulated_measurements_beats_them_and_the_odometry() -> None:
    truth = winding_drive(400)
    settings = EmulatedRunSettings(particles=600, kept_particles=600, smoother=QUICK)
    run = run_emulated(truth, emulate_odometry(truth, 1), settings)
    mean = {name: row["position_error_m"]["mean"] for name, row in run.metrics.items()}
    assert list(mean) == ["prior", "odometry", "single_shot", "filter", "smoother", "graph"]
    assert 2.0 * mean["filter"] < min(mean["single_shot"], mean["odometry"], mean["prior"])
    assert mean["smoother"] < mean["filter"]
    assert mean["graph"] < mean["filter"]
    assert len(run.measured) == pytest.approx(100, abs=3)
    np.testing.assert_array_equal(run.smoother.stamp_ns, truth.stamp_ns)
    assert run.table().startswith("emulated TransLocNet")
    again = run_emulated(truth, emulate_odometry(truth, 1), settings)
    np.testing.assert_array_equal(again.smoother.poses, run.smoother.poses)


def test_errors_that_repeat_flatten_what_the_graph_gets_more_than_what_the_filter_gets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = winding_drive(300)
    settings = EmulatedRunSettings(
        emulator=EmulatorSettings(step_correlation=0.9), particles=600, kept_particles=600, smoother=QUICK
    )
    run = run_emulated(truth, emulate_odometry(truth, 1), settings)
    monkeypatch.setattr(sequences.emulated_run, "smoothing_temperature", lambda correlation, temperature: temperature)
    as_filter = run_emulated(truth, emulate_odometry(truth, 1), settings)
    np.testing.assert_array_equal(run.filter.covariances, as_filter.filter.covariances)
    claimed, proud = (one.graph.covariances for one in (run, as_filter))
    assert claimed is not None
    assert proud is not None
    assert np.median(np.linalg.det(claimed) / np.linalg.det(proud)) > 1.5


def test_settings_reach_the_run() -> None:
    truth = winding_drive(60)
    settings = EmulatedRunSettings(
        ORIENTERNET_KITTI_SEQUENTIAL,
        particles=300,
        measure_every_m=0.0,
        smoother=QUICK,
        calibration=OdometryCalibration(clock_offset_s=0.1),
    )
    run = run_emulated(truth, emulate_odometry(truth, 1), settings)
    assert len(run.measured) == 60
    assert "OrienterNet" in run.name
    assert EmulatedRunSettings(emulator=EmulatorSettings(step_correlation=0.9)).correlation(4.0) == 0.9
    assert EmulatedRunSettings(emulator=EmulatorSettings(step_correlation=0.9)).correlation(np.inf) == 0.0
    long = EmulatorSettings(correlation_length_m=4.0)
    assert EmulatedRunSettings(emulator=long).correlation(4.0) == pytest.approx(np.exp(-1))
    assert EmulatedRunSettings(emulator=long, handled_length_m=0.0).correlation(4.0) == 0.0
    assert EmulatedRunSettings().correlation(4.0) == 0.0


def test_bad_settings_are_refused() -> None:
    for word, call in {
        "seed": lambda: EmulatedRunSettings(seed=-1),
        "particles": lambda: EmulatedRunSettings(particles=0),
        "measure_every_m": lambda: EmulatedRunSettings(measure_every_m=np.nan),
        "handled_length_m": lambda: EmulatedRunSettings(handled_length_m=-1.0),
        "two poses": lambda: run_emulated(winding_drive(1), winding_drive(5)),
    }.items():
        with pytest.raises(SkyfixError, match=word):
            call()


def test_a_kilometre_of_real_odometry(shared_data: Callable[[str], Path]) -> None:
    """KITTI 00's first 1200 frames, real stereo odometry, emulated TransLocNet every 4 m."""
    sequence = FolderSequence(shared_data("kitti00"))
    assert sequence.ground_truth is not None
    truth = Trajectory(sequence.ground_truth.stamp_ns[:1200], sequence.ground_truth.poses[:1200])
    settings = EmulatedRunSettings(particles=1000, kept_particles=1000, smoother=QUICK)
    run = run_emulated(truth, sequence.odometry("sptam"), settings)
    metrics = run.metrics
    assert metrics["single_shot"]["position_error_m"]["mean"] > 5.0
    assert metrics["filter"]["position_error_m"]["mean"] < 2.5
    assert metrics["smoother"]["position_error_m"]["mean"] < 1.4
    assert 0.4 < metrics["smoother"]["nees"]["mean"] / 3 < 1.6
    assert metrics["graph"]["position_error_m"]["mean"] < 1.0
    assert 0.4 < metrics["graph"]["nees"]["mean"] / 3 < 1.6
    again = run_emulated(
        truth, sequence.odometry("sptam"), replace(settings, calibration=run.filter_calibration)
    ).metrics
    assert again["filter"]["position_error_m"]["mean"] < 0.9 * metrics["filter"]["position_error_m"]["mean"]
    assert again["filter"]["heading_error_deg"]["mean"] < 0.9 * metrics["filter"]["heading_error_deg"]["mean"]
    assert 0.4 < again["filter"]["nees"]["mean"] / 3 < 1.6
