"""Choices that `skyfix track --set` gives reach the drive, and track it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive, write_made_drive

from learned.matcher import load_matcher
from sequences.dotted_keys import changed
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.run_result import RunResult
from sequences.track_settings import SETTABLE, TrackSettings

SETTINGS = TrackSettings("wheels", seed=3, particles=3000)


def with_choices(settings: TrackSettings, *overrides: str) -> TrackSettings:
    return changed(settings, overrides, SETTABLE)


def run(made: MadeDrive, *overrides: str) -> RunResult:
    settings = with_choices(SETTINGS, *overrides)
    return track(FolderSequence(made.path), EmulatedMatcher(made.truth.poses), settings)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> MadeDrive:
    return write_made_drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="module")
def as_usual(drive: MadeDrive) -> RunResult:
    return run(drive)


@pytest.mark.parametrize(
    "override",
    [
        "filter.resampler=residual",
        "filter.adaptive={least: 1000, most: 20000}",
        "filter.guided_below=.inf",
        "filter.outlier_probability=0.2",
        "search.min_half_extent_m=8",
        "smoother.odometry_kernel=none",
        "noise.longitudinal_m_per_sqrt_m=0.2",
    ],
)
def test_each_choice_tracks_the_drive_and_changes_it(drive: MadeDrive, as_usual: RunResult, override: str) -> None:
    chosen = run(drive, override)
    assert chosen.metrics["filter"]["position_error_m"]["mean"] < 0.9
    assert chosen.metrics["smoother"]["position_error_m"]["mean"] < 0.7
    assert all(np.isfinite(getattr(chosen, name).poses).all() for name in ("filter", "smoother"))
    changes = "smoother" if override.startswith("smoother") else "filter"
    assert not np.array_equal(getattr(chosen, changes).poses, getattr(as_usual, changes).poses)


@pytest.mark.parametrize("override", ["filter.guided_below=.inf", "filter.adaptive={}"])
def test_real_scans_with_a_guided_and_an_adaptive_cloud(shared_data: Callable[[str], Path], override: str) -> None:
    """Sharp likelihoods whose clouds hold weights too small for an inverse."""
    settings = with_choices(TrackSettings("lidar_gicp", seed=0), override)
    metrics = track(FolderSequence(shared_data("kitti_raw_0013_start")), load_matcher("rotmatch"), settings).metrics
    assert metrics["filter"]["position_error_m"]["mean"] < 0.8
    assert metrics["filter"]["ellipse95"] == 1.0
