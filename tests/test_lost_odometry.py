"""A drive is tracked on while its odometry is lost: the filter, the smoother, and what is found of the odometry."""

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive, write_made_drive

from fusion import MotionKind, OdometryCalibration, Trajectory, se2
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.run_result import RunResult
from sequences.track_settings import TrackSettings
from sequences.trajectory_io import write_tum

SECOND = 1_000_000_000
LOST_FROM, LOST_UNTIL = 41, 56
"""Frames without odometry: 3.2 s, 32 m."""


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> MadeDrive:
    """200 m, 20 s. Odometry `lost` goes on from where it was lost; `early` does so on a clock that is 1 s behind."""
    made = write_made_drive(tmp_path_factory.mktemp("lost") / "drive", frames=100, map_half_extent_m=120.0)
    poses, kept = made.odometry.poses.copy(), np.ones(100, dtype=bool)
    kept[LOST_FROM:LOST_UNTIL] = False
    poses[LOST_UNTIL:] = se2.compose(poses[LOST_FROM - 1], se2.between(poses[LOST_UNTIL - 1], poses[LOST_UNTIL:]))
    for name, late_ns in (("lost", 0), ("early", SECOND)):
        told = Trajectory(made.odometry.stamp_ns[kept] - late_ns, poses[kept], None, name)
        write_tum(made.path / "odometry" / f"{name}.tum", told)
    return made


def run(made: MadeDrive, odometry: str, calibration: OdometryCalibration | None = None) -> RunResult:
    settings = TrackSettings(odometry, seed=3, particles=3000, calibration=calibration, snapshots=0)
    return track(FolderSequence(made.path), EmulatedMatcher(made.truth.poses), settings)


@pytest.mark.parametrize(
    ("odometry", "calibration"), [("lost", None), ("early", OdometryCalibration(clock_offset_s=1.0))]
)
def test_filter_and_smoother_stay_with_the_vehicle_and_know_how_well(lost, odometry, calibration):
    result = run(lost, odometry, calibration)
    assert result.odometry_doubts.kinds == (MotionKind.GAP,)
    assert result.metrics["odometry"]["position_error_m"]["max"] > 25.0
    for method, mean_m, most_m in (("filter", 0.9, 4.5), ("smoother", 0.5, 2.5)):
        errors = result.metrics[method]["position_error_m"]
        assert errors["mean"] < mean_m
        assert errors["max"] < most_m
        assert result.metrics[method]["nees"]["mean"] < 3.0
    assert result.metrics["trust"]["doubts"] == []


def test_scans_are_matched_as_often_as_the_vehicle_may_have_moved(lost):
    """Though odometry says that it stands still."""
    lost_run, good_run = run(lost, "lost"), run(lost, "wheels")
    measured = [[row.measured for row in result.frame_rows] for result in (lost_run, good_run)]
    assert sum(measured[0][LOST_FROM:LOST_UNTIL]) >= 6  # every 4 m of 32
    assert abs(sum(measured[0]) - sum(measured[1])) <= 3


def test_what_was_lost_is_no_error_of_the_odometry(lost):
    found, usual = run(lost, "lost").odometry_calibration, run(lost, "wheels").odometry_calibration
    assert found.log_scale == pytest.approx(usual.log_scale, abs=0.01)
    assert found.along_noise < 1.5 * usual.along_noise
    assert found.heading_noise < 1.5 * usual.heading_noise
