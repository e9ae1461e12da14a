"""The table of tracked drives by what is wrong with their odometry: every fault is what it says."""

import numpy as np
import pytest
from made_drive import EmulatedMatcher, write_made_drive

from benchmarks import odometry_faults
from benchmarks.odometry_faults import FAULTS, FaultyOdometry, jumps, lost, without
from fusion import SkyfixError, Trajectory, se2
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.track_settings import TrackSettings

SECOND = 1_000_000_000


@pytest.fixture
def odometry() -> Trajectory:
    """100 s at 8 m/s through a long bend."""
    yaw = np.linspace(0.0, 2.0, 1000)
    steps = 0.8 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return Trajectory(
        np.arange(1000) * SECOND // 10, np.column_stack([np.cumsum(steps, axis=0), yaw]), None, "odometry"
    )


def moved(odometry: Trajectory) -> np.ndarray:
    return se2.between(odometry.poses[:-1], odometry.poses[1:])


def test_a_gap_leaves_out_samples_and_nothing_else(odometry):
    gone = without(10.0)(odometry)
    assert np.diff(gone.stamp_ns).max() == pytest.approx(10.1 * SECOND, rel=0.02)
    left = np.isin(odometry.stamp_ns, gone.stamp_ns)
    np.testing.assert_array_equal(gone.poses, odometry.poses[left])
    with pytest.raises(SkyfixError, match="expected 80 s and more"):
        without(80.0)(odometry)


def test_jumps_are_motions_that_were_none(odometry):
    jumped = jumps((300.0, 0.0, 0.0), 2)(odometry)
    other = np.flatnonzero(np.linalg.norm(moved(jumped) - moved(odometry), axis=1) > 1e-6)
    assert len(other) == 2
    np.testing.assert_allclose(moved(jumped)[other], [[300.0, 0.0, 0.0]] * 2, atol=1e-9)


@pytest.mark.parametrize("is_told", [True, False])
def test_a_lost_odometry_misses_a_part_of_the_way(odometry, is_told):
    found = lost(20.0, is_told=is_told)(odometry)
    assert len(found) == (1000 if is_told else 800)
    assert odometry.length_m - found.length_m == pytest.approx(200 * 0.8, rel=1e-3)
    np.testing.assert_allclose(moved(found)[-490:], moved(odometry)[-490:], atol=1e-9)


def test_rows_are_of_what_track_finds_with_the_prior_and_the_odometry(tmp_path, monkeypatch, capsys):
    made = write_made_drive(tmp_path / "made_drive")
    matcher = EmulatedMatcher(made.truth.poses)
    chosen = {name: FAULTS[name] for name in ("none", "a jump of 300 m")}
    monkeypatch.setattr(odometry_faults, "FAULTS", chosen)
    monkeypatch.setattr(odometry_faults, "load_matcher", lambda name: matcher)
    odometry_faults.main(made.path, seeds="0,1")
    lines = capsys.readouterr().out.splitlines()
    assert "made_drive, real scans, emulated, odometry wheels, seeds 0,1" in lines
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")][2:]
    labels = ("prior", "odometry only", "filter", "smoother")
    assert [(row[0], row[1]) for row in rows] == [(fault, label) for fault in chosen for label in labels]
    sequence = FaultyOdometry(FolderSequence(made.path), chosen["a jump of 300 m"])
    settings = [TrackSettings("wheels", seed=seed, snapshots=0) for seed in (0, 1)]
    means = [track(sequence, matcher, each).metrics["smoother"]["position_error_m"]["mean"] for each in settings]
    assert rows[-1][2] == f"{np.mean(means):.2f} ± {np.std(means, ddof=1):.2f}"
    assert float(rows[5][2].split()[0]) > 100.0  # odometry only, as it comes


def test_what_cannot_be_measured_is_refused(tmp_path):
    made = write_made_drive(tmp_path / "made_drive")
    (made.path / "ground_truth.tum").unlink()
    with pytest.raises(SkyfixError, match="expected ground truth to compare with"):
        odometry_faults.main(made.path)
