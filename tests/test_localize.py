"""The tracking loop, with an emulated matcher: what it may know, what it must do, what it reports."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from made_drive import STEP_M, EmulatedMatcher, MadeDrive, made_scan

import sequences.run_directory as run_directory
from fusion import se2
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.odometry_errors import OdometryCalibration
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from sequences.drive import load_drive
from sequences.figures import frames_figure, series_of
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.measurement import Measurement
from sequences.run_directory import write_run
from sequences.run_metrics import TIMING_KEYS
from sequences.run_result import FrameRow, RunResult
from sequences.sequence import ScanError
from sequences.start import prior_answers, start_prior
from sequences.track_settings import TrackSettings
from sequences.trajectory_io import read_tum, write_tum

SETTINGS = TrackSettings("wheels", seed=3, particles=3000)


def run(made: MadeDrive, settings: TrackSettings = SETTINGS, **matcher: Any) -> RunResult:
    return track(FolderSequence(made.path), EmulatedMatcher(made.truth.poses, **matcher), settings)


def lasting(metrics: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in metrics.items() if key not in TIMING_KEYS}


def test_fusion_beats_its_parts(made_drive: MadeDrive) -> None:
    metrics = run(made_drive).metrics
    mean = {name: metrics[name]["position_error_m"]["mean"] for name in ("prior", "odometry", "single_shot", "filter")}
    assert mean["filter"] < 0.8
    assert mean["filter"] < mean["odometry"]
    assert mean["filter"] < mean["prior"]
    assert metrics["smoother"]["position_error_m"]["mean"] < mean["single_shot"]
    assert metrics["filter_after_first_quarter"]["lateral_recall"]["1"] == 1.0
    assert metrics["measured_frames"] == 15
    assert metrics["single_shot"]["frames"] == 15
    assert metrics["filter"]["frames"] == 30
    assert metrics["length_m"] == pytest.approx(29 * STEP_M, rel=0.01)


def test_same_seed_same_numbers_other_seed_others(made_drive: MadeDrive) -> None:
    first, again = run(made_drive), run(made_drive)
    assert json.dumps(lasting(first.metrics)) == json.dumps(lasting(again.metrics))
    np.testing.assert_array_equal(first.filter.poses, again.filter.poses)
    np.testing.assert_array_equal(first.smoother.poses, again.smoother.poses)
    other = run(made_drive, replace(SETTINGS, seed=4))
    assert not np.array_equal(first.prior.mean, other.prior.mean)
    assert lasting(other.metrics)["filter"] != lasting(first.metrics)["filter"]


def test_the_truth_is_not_tracked_with(made_drive: MadeDrive) -> None:
    settings = replace(SETTINGS, start=(-22.0, -12.0, 20.0))
    with_truth = run(made_drive, settings)
    (made_drive.path / "ground_truth.tum").unlink()
    without = run(made_drive, settings)
    np.testing.assert_array_equal(without.filter.poses, with_truth.filter.poses)
    np.testing.assert_array_equal(without.smoother.poses, with_truth.smoother.poses)
    assert without.truth is None
    assert without.metrics["ground_truth"] is False
    assert "filter" not in without.metrics
    assert without.length_m == pytest.approx(made_drive.odometry.length_m)


@pytest.mark.parametrize(("first", "last"), [(0, 14), (6, 30), (10, 12)])
def test_ground_truth_of_a_part_scores_that_part_and_cuts_nothing(
    made_drive: MadeDrive, tmp_path: Path, first: int, last: int
) -> None:
    settings = replace(SETTINGS, start=(-22.0, -12.0, 20.0))
    whole = run(made_drive, settings)
    part = Trajectory(made_drive.truth.stamp_ns[first:last], made_drive.truth.poses[first:last])
    write_tum(made_drive.path / "ground_truth.tum", part)
    result = run(made_drive, settings)
    np.testing.assert_array_equal(result.filter.poses, whole.filter.poses)
    np.testing.assert_array_equal(result.smoother.poses, whole.smoother.poses)
    assert (result.metrics["frames"], result.metrics["filter"]["frames"]) == (30, last - first)
    errors = np.linalg.norm((whole.smoother.poses - made_drive.truth.poses)[first:last, :2], axis=1)
    assert result.metrics["smoother"]["position_error_m"]["mean"] == pytest.approx(errors.mean(), abs=1e-5)
    assert f"errors are of the {last - first} frames that the ground truth covers" in result.log
    write_run(result, tmp_path / "run")
    with (tmp_path / "run" / "frames.csv").open(newline="") as file:
        told = [bool(line["filter_error_m"]) for line in csv.DictReader(file)]
    assert told == [first <= number < last for number in range(30)]
    assert f"at the {last - first} of 30 frames that it covers" in (tmp_path / "run" / "report.html").read_text()


def test_a_start_drawn_about_the_truth_begins_where_the_truth_does(made_drive: MadeDrive) -> None:
    write_tum(
        made_drive.path / "ground_truth.tum",
        Trajectory(made_drive.truth.stamp_ns[4:20], made_drive.truth.poses[4:20]),
    )
    result = run(made_drive)
    assert (result.metrics["frames"], result.metrics["filter"]["frames"]) == (26, 16)
    assert np.abs(result.prior.mean[:2] - made_drive.truth.poses[4, :2]).max() <= 20.0
    assert result.log[1].startswith("4 frames left out: not covered by the odometry, or before the ground truth")


def test_a_single_shot_that_no_truth_covers_is_not_scored(made_drive: MadeDrive) -> None:
    part = Trajectory(made_drive.truth.stamp_ns[11:14], made_drive.truth.poses[11:14])
    write_tum(made_drive.path / "ground_truth.tum", part)
    result = run(made_drive, replace(SETTINGS, start=(-22.0, -12.0, 20.0), measure_every_frames=10))
    assert "single_shot" not in result.metrics
    assert "single_shot" not in series_of(result).errors
    assert result.metrics["filter"]["frames"] == 3


def test_an_odometry_whose_errors_are_known_carries_the_filter_further(made_drive: MadeDrive) -> None:
    """It is 3 % too long and turns by 0.2 degrees every 2 m; a measurement comes every 10 m."""
    known = OdometryCalibration(log_scale=-float(np.log(1.03)), heading_bias_rad_per_m=-float(np.deg2rad(0.2)) / 2.06)
    rare = replace(SETTINGS, measure_every_frames=5, start=tuple(made_drive.truth.poses[0] * [1.0, 1.0, 180.0 / np.pi]))
    as_it_comes, corrected = run(made_drive, rare), run(made_drive, replace(rare, calibration=known))
    mean = [result.metrics["filter"]["heading_error_deg"]["mean"] for result in (as_it_comes, corrected)]
    assert mean[1] < 0.7 * mean[0]
    np.testing.assert_array_equal(corrected.odometry.poses, as_it_comes.odometry.poses)  # which is shown as it came


def test_an_odometry_that_is_known_to_be_noisy_leaves_the_filter_less_sure(made_drive: MadeDrive) -> None:
    known = [OdometryCalibration(), OdometryCalibration(along_noise=4.0, across_noise=4.0, heading_noise=4.0)]
    results = [run(made_drive, replace(SETTINGS, measure_every_frames=5, calibration=one)) for one in known]
    spread = [np.linalg.det(covariances_of(result.filter)[7:]).mean() for result in results]
    assert spread[1] > 2.0 * spread[0]


def covariances_of(estimate: Trajectory) -> np.ndarray:
    assert estimate.covariances is not None
    return estimate.covariances


def test_the_true_start_is_anywhere_in_the_prior(made_drive: MadeDrive) -> None:
    drive = load_drive(FolderSequence(made_drive.path), "wheels")
    priors = [start_prior(drive, replace(SETTINGS, seed=seed)) for seed in range(400)]
    true_start = drive.truth.poses[0] if drive.truth is not None else np.zeros(3)
    offsets = np.array([prior.mean - true_start for prior in priors])
    offsets[:, 2] = se2.wrap(offsets[:, 2])
    assert all(prior.contains(true_start) for prior in priors)
    half = np.array([20.0, 20.0, np.deg2rad(10.0)])
    # Uniform over +-half: mean 0 with deviation half / sqrt(3 * 400), mean square half^2 / 3.
    np.testing.assert_array_less(np.abs(offsets.mean(axis=0)), 4.0 * half / np.sqrt(3 * 400))
    np.testing.assert_allclose((offsets**2).mean(axis=0), half**2 / 3.0, rtol=0.2)


def test_the_prior_scores_what_the_middle_of_its_box_scores() -> None:
    n = 20_000
    truth = Trajectory(np.arange(n, dtype=np.int64), np.column_stack([np.arange(n), np.zeros((n, 2))]))
    answers = prior_answers(truth, TrackSettings("any"))
    distance = np.hypot(*(answers.poses - truth.poses)[:, :2].T)
    # Mean distance of a uniform point in a square to its centre: half side * (sqrt 2 + ln(1 + sqrt 2)) / 3 = 15.304 m.
    assert distance.mean() == pytest.approx(20.0 * (np.sqrt(2) + np.log(1 + np.sqrt(2))) / 3.0, abs=0.15)
    heading_deg = np.rad2deg(np.abs(se2.wrap(answers.poses[:, 2] - truth.poses[:, 2])))
    assert heading_deg.mean() == pytest.approx(5.0, abs=0.1)


def test_a_search_covers_the_start_until_it_is_settled_then_follows_the_filter(made_drive: MadeDrive) -> None:
    matcher = EmulatedMatcher(made_drive.truth.poses)
    result = track(FolderSequence(made_drive.path), matcher, SETTINGS)
    measured = [row for row in result.frame_rows if row.measured]
    assert len(measured) == len(matcher.searches)
    for search, row in zip(matcher.searches, measured, strict=True):
        assert row.search_half_extent_m == search.half_extent_m
        assert row.search_half_heading_rad == search.half_heading_rad
    np.testing.assert_array_equal(matcher.searches[0].centre, result.prior.mean)
    assert [search.half_extent_m >= 22.0 for search in matcher.searches[:5]] == [True, True, True, True, False]
    for search, row in zip(matcher.searches[4:], measured[4:], strict=True):
        assert search.half_extent_m == 12.0
        frame = int(np.flatnonzero(result.stamps_ns == row.stamp_ns)[0])
        assert np.hypot(*(search.centre - result.filter.poses[frame])[:2]) < 3.0
        assert not np.array_equal(search.centre, made_drive.truth.poses[frame])


def test_a_first_scan_that_fits_the_wrong_street_does_not_decide(made_drive: MadeDrive) -> None:
    wrong = {0: np.array([6.0, 9.0, np.pi])}
    settings = replace(SETTINGS, half_heading_deg=180.0)
    result = run(made_drive, settings, mistakes=wrong)
    errors = np.hypot(*(result.filter.poses - made_drive.truth.poses)[:, :2].T)
    assert errors[0] > 5.0
    assert errors[5:].max() < 2.5


@pytest.mark.parametrize(("every_m", "gap"), [(0.0, 1), (4.0, 2), (10.0, 5)])
def test_scans_are_measured_every_so_many_metres(made_drive: MadeDrive, every_m: float, gap: int) -> None:
    result = run(made_drive, replace(SETTINGS, measure_every_m=every_m))
    measured = np.flatnonzero([row.measured for row in result.frame_rows])
    assert measured[0] == 0
    assert set(np.diff(measured)) == {gap}  # the odometry is 3 % long: 2.06 m a frame


def test_scans_are_measured_every_so_many_frames(made_drive: MadeDrive) -> None:
    result = run(made_drive, replace(SETTINGS, measure_every_frames=7))
    assert np.flatnonzero([row.measured for row in result.frame_rows]).tolist() == [0, 7, 14, 21, 28]


def test_correlated_errors_flatten_every_measurement_but_the_first(made_drive: MadeDrive) -> None:
    rows = run(made_drive, error_correlation_length_m=10.0).frame_rows
    temperatures = [row.temperature for row in rows if row.measured]
    rho = np.exp(-2 * 1.03 * STEP_M / 10.0)
    assert temperatures[0] == 1.0
    np.testing.assert_allclose(temperatures[1:], (1 + rho) / (1 - rho), rtol=1e-3)
    overridden = run(made_drive, replace(SETTINGS, correlation_length_m=0.0), error_correlation_length_m=10.0)
    assert {row.temperature for row in overridden.frame_rows if row.measured} == {1.0}


def test_a_matcher_may_know_that_its_errors_repeat_over_more_on_this_map(made_drive: MadeDrive) -> None:
    class OnBareMaps(EmulatedMatcher):
        def error_correlation_length_on(self, map_raster: MapRaster) -> float:
            return 10.0 if map_raster.shows_buildings else 99.0

    rows = track(FolderSequence(made_drive.path), OnBareMaps(made_drive.truth.poses), SETTINGS).frame_rows
    known = run(made_drive, error_correlation_length_m=10.0).frame_rows
    assert [row.temperature for row in rows] == [row.temperature for row in known]


def test_a_bad_scan_is_skipped_and_reported(made_drive: MadeDrive) -> None:
    made_drive.scan_file(6).write_bytes(b"")
    result = run(made_drive, replace(SETTINGS, measure_every_frames=3))
    row = result.frame_rows[6]
    assert not row.measured
    assert "expected points, got none" in row.skipped_reason
    assert result.metrics["skipped_frames"] == 1
    assert any("frame 6" in line and "expected points" in line for line in result.log)
    assert result.frame_rows[7].measured  # the next one takes its place
    assert result.metrics["filter"]["position_error_m"]["max"] < 3.0


def test_a_first_scan_that_is_bad_ends_the_run(made_drive: MadeDrive) -> None:
    points = made_scan(0)
    points[3, 2] = np.inf
    points.tofile(made_drive.scan_file(0))
    with pytest.raises(ScanError, match=r"scan 000000\.bin: expected finite points"):
        run(made_drive)


def test_odometry_that_covers_a_part_tracks_that_part(made_drive: MadeDrive) -> None:
    lines = (made_drive.path / "odometry" / "wheels.tum").read_text().splitlines()
    (made_drive.path / "odometry" / "wheels.tum").write_text("\n".join(lines[5:25]) + "\n")
    result = run(made_drive)
    np.testing.assert_array_equal(result.stamps_ns, made_drive.truth.stamp_ns[5:25])
    assert [row.index for row in result.frame_rows] == list(range(5, 25))
    assert result.metrics["filter"]["position_error_m"]["mean"] < 1.0
    assert any("10 frames left out" in line for line in result.log)
    assert len(result.snapshots) > 0
    write_run(result, str(made_drive.path / "run"))  # whose pictures show the frames by the numbers of their scans
    figure = frames_figure(result, series_of(result))
    assert figure.axes[0].get_title() == "frame 5, 0 m"


def test_times_in_another_unit_are_refused(made_drive: MadeDrive) -> None:
    def in_nanoseconds(path: Path) -> None:
        lines = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
        first = float(lines[0][0])
        path.write_text(
            "\n".join(" ".join([f"{(float(time) - first) * 1e9:.0f}", *rest]) for time, *rest in lines) + "\n"
        )

    in_nanoseconds(made_drive.path / "odometry" / "wheels.tum")
    with pytest.raises(SkyfixError, match="odometry 'wheels': expected times in seconds, got steps of"):
        run(made_drive)
    in_nanoseconds(made_drive.path / "scans" / "times.txt")
    with pytest.raises(SkyfixError, match="scans: expected times in seconds, got steps of"):
        run(made_drive)


def test_a_matcher_that_answers_with_anything_else_is_told(made_drive: MadeDrive) -> None:
    class Silent(EmulatedMatcher):
        def match(self, *asked: Any) -> Any:
            super().match(*asked)

    with pytest.raises(
        SkyfixError, match=r"matcher .*: expected match\(\) to answer with a LikelihoodVolume, got NoneType"
    ):
        track(FolderSequence(made_drive.path), Silent(made_drive.truth.poses), SETTINGS)


def test_an_unknown_heading_is_found(made_drive: MadeDrive) -> None:
    result = run(made_drive, replace(SETTINGS, half_heading_deg=180.0))
    assert result.prior.half_heading_rad == np.pi
    assert result.metrics["filter"]["heading_error_deg"]["mean"] < 2.0


def test_reported_covariances_include_the_maps_own_error(made_drive: MadeDrive) -> None:
    without = run(made_drive, replace(SETTINGS, map_error_m=0.0))
    with_error = run(made_drive, replace(SETTINGS, map_error_m=0.7))
    for name in ("filter", "smoother"):
        added = getattr(with_error, name).covariances - getattr(without, name).covariances
        np.testing.assert_allclose(added, np.broadcast_to(np.diag([0.49, 0.49, 0.0]), added.shape), atol=1e-12)


def test_progress_hears_of_every_frame(made_drive: MadeDrive) -> None:
    class Recorder:
        def __init__(self) -> None:
            self.frames = 0
            self.errors: list[float | None] = []

        def start(self, frames: int) -> None:
            self.frames = frames

        def frame(self, row: FrameRow, error_m: float | None) -> None:
            self.errors.append(error_m)

    recorder = Recorder()
    result = track(FolderSequence(made_drive.path), EmulatedMatcher(made_drive.truth.poses), SETTINGS, recorder)
    assert recorder.frames == len(recorder.errors) == 30
    expected = np.hypot(*(result.filter.poses - made_drive.truth.poses)[:, :2].T)
    np.testing.assert_allclose(np.array(recorder.errors, dtype=float), expected, atol=1e-6)


@pytest.mark.parametrize("yaw", [0.02, 3.1, -3.13])
def test_the_best_pose_is_finer_than_a_cell(yaw: float) -> None:
    grid = MapGrid(60, 60, 0.5, -15.0, -15.0)
    x, y = grid.centres()
    bins = np.arange(120) * 2.0 * np.pi / 120
    squared = ((x[None, :, None] - 1.37) ** 2 + (y[:, None, None] + 2.21) ** 2) / 0.3**2
    squared = squared + (se2.wrap(bins - yaw) / np.deg2rad(2.0)) ** 2
    volume = LikelihoodVolume.from_scores(-0.5 * squared, grid)
    search = SearchRegion(np.zeros(3), 10.0)
    best = Measurement(np.zeros((1, 4), np.float32), search, volume, 1.0).best_pose()
    assert np.hypot(best[0] - 1.37, best[1] + 2.21) < 0.1
    assert abs(se2.wrap(best[2] - yaw)) < np.deg2rad(0.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"particles": 0}, "particles: expected more than 0"),
        ({"half_extent_m": -1.0}, "half_extent_m: expected more than 0"),
        ({"half_heading_deg": 200.0}, "half_heading_deg: expected at most 180"),
        ({"half_extent_m": float("nan")}, "half_extent_m: expected a finite number"),
        ({"start": (0.0, float("inf"), 0.0)}, "start: expected a finite number"),
        ({"start": (0.0, 1.0)}, "start: expected x, y .m. and yaw .degrees., got 2 numbers"),
        ({"measure_every_m": -4.0}, "measure_every_m: expected 0 or more"),
        ({"measure_every_frames": 0}, "measure_every_frames: expected 1 or more"),
        ({"correlation_length_m": -1.0}, "correlation_length_m: expected 0 or more"),
        ({"seed": -1}, "seed: expected 0 or more"),
    ],
)
def test_settings_are_checked(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SkyfixError, match=message):
        replace(SETTINGS, **changes)


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the report's figures to their own tests."""

    def write_empty(result: RunResult, out_dir: Path) -> Path:
        (out_dir / "report.html").write_text("")
        return out_dir / "report.html"

    monkeypatch.setattr(run_directory, "write_report", write_empty)


@pytest.mark.usefixtures("without_report")
def test_a_run_directory_holds_the_run(made_drive: MadeDrive, tmp_path: Path) -> None:
    result = run(made_drive)
    write_run(result, tmp_path / "runs" / "one")
    out = tmp_path / "runs" / "one"
    names = {"config.yaml", "metrics.json", "report.html", "frames.csv", "log.txt"}
    names |= {f"{method}.tum" for method in ("filter", "smoother", "odometry", "single_shot")}
    assert {file.name for file in out.iterdir()} == names
    assert [entry.name for entry in out.parent.iterdir()] == ["one"]
    assert json.loads((out / "metrics.json").read_text()) == result.metrics
    np.testing.assert_allclose(read_tum(out / "filter.tum").poses, result.filter.poses, atol=1e-8)
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert (config["seed"], config["odometry"], config["matcher"]) == (3, "wheels", "emulated")
    assert config["noise"]["longitudinal_m_per_sqrt_m"] == result.settings.noise.longitudinal_m_per_sqrt_m
    assert (config["filter"]["resampler"], config["search"]["patience"]) == ("systematic", 3)
    with (out / "frames.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 30
    errors = [float(line["smoother_error_m"]) for line in lines]
    assert np.mean(errors) == pytest.approx(result.metrics["smoother"]["position_error_m"]["mean"], abs=1e-4)
    assert (lines[0]["measured"], lines[1]["measured"]) == ("1", "0")
    assert lines[1]["log_evidence"] == lines[1]["match_ms"] == ""


@pytest.mark.usefixtures("without_report")
def test_a_run_is_replaced_only_when_asked_and_anything_else_never(made_drive: MadeDrive, tmp_path: Path) -> None:
    result, out = run(made_drive), tmp_path / "out"
    out.mkdir()  # an empty folder is there to be filled
    write_run(result, out)
    with pytest.raises(SkyfixError, match="holds a run already; give --overwrite"):
        write_run(result, out)
    (out / "mine.txt").write_text("of the old run")
    write_run(result, out, overwrite=True)
    assert not (out / "mine.txt").exists()
    other = tmp_path / "holiday"
    other.mkdir()
    (other / "photo.png").write_bytes(b"1")
    with pytest.raises(SkyfixError, match="exists and is not a run directory"):
        write_run(result, other, overwrite=True)
    assert (other / "photo.png").exists()


def test_a_run_that_cannot_be_written_leaves_nothing(
    made_drive: MadeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(result: RunResult, out_dir: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_directory, "write_report", fail)
    with pytest.raises(SkyfixError, match="cannot be written: No space left on device"):
        write_run(run(made_drive), tmp_path / "runs" / "one")
    assert list((tmp_path / "runs").iterdir()) == []


def test_patches_for_the_smoother_are_the_flattened_likelihood_near_the_estimate() -> None:
    grid = MapGrid(80, 80, 0.5, -20.0, -20.0)
    x, y = grid.centres()
    bins = np.arange(120) * 2.0 * np.pi / 120
    squared = (x[None, :, None] ** 2 + y[:, None, None] ** 2) / 0.8**2 + (se2.wrap(bins) / 0.1) ** 2
    volume = LikelihoodVolume.from_scores(-0.5 * np.minimum(squared, 30.0), grid)
    scan = np.zeros((1, 4), np.float32)
    estimate = Estimate(0, np.array([1.0, -2.0, 0.05]), np.diag([0.5, 0.5, 0.02]) ** 2, None, 1.0, 0.0, 0.0)
    patch = Measurement(scan, SearchRegion(np.zeros(3), 10.0), volume, 4.0).patch(estimate)
    assert patch.log_prob.size < volume.log_prob.size / 20
    x, y = patch.grid.centres()
    yaw = (patch.first_bin + np.arange(patch.log_prob.shape[2])) * 2.0 * np.pi / patch.bin_count
    poses = np.stack(np.meshgrid(y, x, yaw, indexing="ij"), axis=-1)[..., [1, 0, 2]].reshape(-1, 3)
    np.testing.assert_allclose(patch.log_prob.ravel(), volume.tempered(4.0).log_density(poses), atol=1e-4)
    assert np.abs(poses - estimate.pose).max(axis=0)[:2].min() > 4.0 * 0.5
