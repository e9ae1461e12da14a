"""An odometry's constant errors: found where the drive shows them, left at zero where nothing does."""

from typing import Any

import numpy as np
import pytest

from fusion import GaussianMixture, OdometryNoise, SmootherSettings, Trajectory, UniformPrior, se2, smooth
from fusion.errors import SkyfixError
from fusion.factor_graph import OdometryDrift
from fusion.odometry import increments_at
from fusion.odometry_calibration import CalibrationPrior, _best_along, calibrate_odometry
from fusion.odometry_errors import OdometryCalibration

SECOND = 1_000_000_000
SPEED = 10.0


def drive(turning: float) -> Trajectory:
    """10 m/s for 60 s at 20 Hz, weaving with a yaw rate of so many radians a second."""
    t = np.arange(0, 60, 0.05)
    yaw = turning * 8.0 / (2 * np.pi) * (1 - np.cos(2 * np.pi * t / 8.0))
    step = 0.5 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * (step[:-1] + step[1:]), axis=0)])
    return Trajectory((t * SECOND).astype(np.int64), np.column_stack([xy, yaw]))


def with_errors(truth: Trajectory, errors: OdometryCalibration) -> Trajectory:
    """The odometry that `errors` put right, in a frame of its own."""
    t = truth.stamp_ns
    inner = t[20:-20]
    xy = truth.interpolate(inner)[:, :2] / np.exp(errors.log_scale)
    span = np.sqrt(12.0) * errors.heading_blur_s * np.linspace(-0.5, 0.5, 41)  # a box with that standard deviation
    at = inner[:, None] + np.round((errors.heading_lead_s + span) * SECOND).astype(np.int64)
    shown = np.unwrap(truth.interpolate(np.clip(at, t[0], t[-1]).ravel())[:, 2]).reshape(at.shape)
    yaw = shown.mean(axis=1) + errors.mount_yaw_rad
    poses = se2.compose(np.array([30.0, -7.0, 1.0]), np.column_stack([xy, yaw]))
    return Trajectory(inner - round(errors.clock_offset_s * SECOND), poses, None, "odometry")


def calibrated(turning: float, errors: OdometryCalibration, seed: int) -> tuple[OdometryCalibration, float]:
    """What is found from noisy positions along a drive, and the smoothed drive's mean heading error, degrees."""
    truth = drive(turning)
    rng = np.random.default_rng(seed)
    stamps = truth.stamp_ns[40:-40:10]
    poses = truth.interpolate(stamps)
    covariance = np.diag([0.3, 0.3, np.deg2rad(1.0)]) ** 2
    seen = [
        GaussianMixture(np.ones(1), (pose + rng.multivariate_normal(np.zeros(3), covariance))[None], covariance[None])
        for pose in poses
    ]
    odometry, noise = with_errors(truth, errors), OdometryNoise()
    initial = Trajectory(stamps, poses, np.repeat(covariance[None], len(stamps), axis=0))
    prior = UniformPrior(poses[0], 5.0, 0.2)
    found = calibrate_odometry(stamps, odometry, noise, seen, prior, initial)
    motions = increments_at(stamps, found.corrected(odometry), found.noise(noise))
    result = smooth(stamps, motions, seen, prior, initial)
    heading = np.abs(se2.wrap(result.trajectory.poses[:, 2] - poses[:, 2]))
    return found, float(np.rad2deg(heading.mean()))


@pytest.mark.parametrize(
    "errors",
    [
        OdometryCalibration(),
        OdometryCalibration(clock_offset_s=-0.17),
        OdometryCalibration(clock_offset_s=0.25, mount_yaw_rad=0.02),
        OdometryCalibration(heading_lead_s=0.2),
        OdometryCalibration(log_scale=0.03, mount_yaw_rad=-0.01),
        OdometryCalibration(0.1, -0.1, -0.015, -0.02),
    ],
    ids=["none", "clock", "clock and mounting", "heading", "scale and mounting", "all"],
)
def test_errors_are_found_in_turns(errors: OdometryCalibration) -> None:
    found, heading_deg = calibrated(0.4, errors, seed=1)
    assert found.clock_offset_s == pytest.approx(errors.clock_offset_s, abs=0.03)
    lead_s = found.heading_lead_s + found.heading_lead_m / SPEED  # at one speed nothing tells them apart
    assert lead_s == pytest.approx(errors.heading_lead_s, abs=0.03)
    assert found.mount_yaw_rad == pytest.approx(errors.mount_yaw_rad, abs=np.deg2rad(0.4))
    assert found.log_scale == pytest.approx(errors.log_scale, abs=0.006)
    assert heading_deg < 0.5


@pytest.mark.parametrize("blur_s", [0.0, 0.36])
def test_headings_that_are_averages_are_sharpened(blur_s: float) -> None:
    """Chords over 1.25 s: the span is found, and most of what they lose in turns is put back."""
    errors = OdometryCalibration(heading_blur_s=blur_s)
    found, heading_deg = calibrated(0.8, errors, seed=3)
    assert found.heading_blur_s == pytest.approx(blur_s, abs=0.12)
    assert heading_deg < 0.5
    truth = drive(0.8)
    odometry = with_errors(truth, errors)
    lost, left = (
        se2.wrap(one.interpolate(truth.stamp_ns[60:-60])[:, 2] - 1.0 - truth.poses[60:-60, 2])
        for one in (odometry, errors.corrected(odometry))
    )
    assert np.abs(left).max() <= 0.1 * np.abs(lost).max() + 1e-9


def test_sharpening_crosses_the_seam_of_headings() -> None:
    """The same drive turned by half a circle, and only as much of the span is used as there is at the ends."""
    errors, odometry = OdometryCalibration(heading_blur_s=0.3), drive(0.8)
    turned = Trajectory(odometry.stamp_ns, se2.compose(np.array([0.0, 0.0, np.pi]), odometry.poses))
    first, second = (errors.corrected(one) for one in (odometry, turned))
    np.testing.assert_allclose(se2.wrap(second.poses[:, 2] - first.poses[:, 2] - np.pi), 0.0, atol=1e-9)
    off = se2.wrap(first.interpolate(odometry.stamp_ns)[:, 2] - odometry.poses[:, 2])
    assert np.abs(off).max() < 0.5 * 0.3**2 * 0.8 * 2.0 * np.pi / 8.0 * 1.1


def test_without_evidence_clocks_are_left_alone() -> None:
    """On a straight road at constant speed no clock can be told from another."""
    found, _ = calibrated(0.0, OdometryCalibration(clock_offset_s=0.2), seed=2)
    assert abs(found.clock_offset_s) < 0.02
    assert abs(found.heading_lead_s) < 0.02
    assert abs(found.heading_lead_m) < 0.2
    assert found.heading_blur_s < 0.05


def test_corrected_undoes_the_errors() -> None:
    """Motions of the corrected odometry are the vehicle's, inside its span and as it last moved just outside."""
    truth, errors = drive(0.3), OdometryCalibration(0.13, 0.08, 0.05, -0.04)
    odometry = with_errors(truth, errors)
    corrected = errors.corrected(odometry)
    at = truth.stamp_ns[40:-40:7]
    moved, expected = corrected.interpolate(at), truth.interpolate(at)
    motions = [se2.between(poses[:-1], poses[1:]) for poses in (moved, expected)]
    np.testing.assert_allclose(motions[0], motions[1], atol=2e-3)
    assert corrected.frame_id == "odometry"
    first, last = corrected.span_ns
    assert first < odometry.span_ns[0]
    assert last > odometry.span_ns[1]


def test_no_correction_is_none() -> None:
    odometry = drive(0.3)
    same = OdometryCalibration().corrected(odometry)
    np.testing.assert_allclose(same.interpolate(odometry.stamp_ns), odometry.poses, atol=1e-12)


def test_for_a_filter_what_wanders_is_noise() -> None:
    """A scale that wanders by some per cent: a state of the graph, or more noise along the way."""
    truth, rng = drive(0.4), np.random.default_rng(4)
    stamps = truth.stamp_ns[::10]
    wander = 0.05 * np.sin(np.arange(len(truth) - 1) / 150.0)
    moves = se2.between(truth.poses[:-1], truth.poses[1:]) * (1.0 + wander[:, None]) ** [1, 1, 0]
    told = [truth.poses[0]]
    for move in moves:
        told.append(se2.compose(told[-1], move))
    odometry = Trajectory(truth.stamp_ns, np.array(told), None, "odometry")
    covariance = np.diag([0.1, 0.1, np.deg2rad(0.5)]) ** 2
    poses = truth.interpolate(stamps)
    off = rng.multivariate_normal(np.zeros(3), covariance, len(poses))
    seen = [
        GaussianMixture(np.ones(1), (pose + by)[None], covariance[None]) for pose, by in zip(poses, off, strict=True)
    ]
    initial = Trajectory(stamps, poses, np.repeat(covariance[None], len(stamps), axis=0))
    noise, prior = OdometryNoise(longitudinal_m_per_sqrt_m=0.02), UniformPrior(poses[0], 5.0, 0.2)
    loose = OdometryDrift(log_scale_walk=0.05, stretch_m=25.0)
    noises = [
        calibrate_odometry(stamps, odometry, noise, seen, prior, initial, SmootherSettings(drift=drift)).along_noise
        for drift in (loose, OdometryDrift.steady())
    ]
    assert noises[1] > 1.5 * noises[0]


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("clock_offset_s", np.nan, "a finite"), ("log_scale", np.inf, "a finite"), ("heading_noise", 0.0, "a positive")],
)
def test_impossible_values_are_named(name: str, value: float, expected: str) -> None:
    with pytest.raises(SkyfixError, match=f"odometry calibration {name}: expected {expected} number, got {value}"):
        OdometryCalibration(**{name: value})


def test_a_negative_blur_is_refused() -> None:
    with pytest.raises(SkyfixError, match=r"odometry calibration heading_blur_s: expected >= 0, got -0\.1"):
        OdometryCalibration(heading_blur_s=-0.1)


@pytest.mark.parametrize("name", ["clock_offset_s", "heading_lead_s", "heading_blur_s", "log_scale", "along_noise"])
def test_values_larger_than_any_odometry_has_are_named(name: str) -> None:
    """No number of nanoseconds, steps or metres overflows: the value is refused before it is used."""
    with pytest.raises(SkyfixError, match=rf"odometry calibration {name}: expected at most .*, got 1000000000000.0"):
        OdometryCalibration(**{name: 1e12})


@pytest.mark.parametrize(("first_ns", "offset_s"), [(0, 9.3e9), (0, -9.3e9), (2**63 - 61 * SECOND, 0.0)])
def test_stamps_that_would_overflow_are_refused(first_ns: int, offset_s: float) -> None:
    odometry = Trajectory(drive(0.3).stamp_ns + first_ns, drive(0.3).poses)
    with pytest.raises(SkyfixError, match="odometry: expected corrected stamps of 64 bits, got"):
        OdometryCalibration(clock_offset_s=offset_s).corrected(odometry)


@pytest.mark.parametrize("clock", [-0.45, 0.0, 0.45])
@pytest.mark.parametrize("lead", [-30.0, -0.45, 0.0, 0.45, 30.0])
def test_corrected_covers_half_a_second_more_than_the_odometry(clock: float, lead: float) -> None:
    odometry = drive(0.3)
    first, last = OdometryCalibration(clock, lead).corrected(odometry).span_ns
    assert first <= odometry.span_ns[0] - SECOND // 2
    assert last >= odometry.span_ns[1] + SECOND // 2


def asked(errors: OdometryCalibration, count: int, missing_s: float) -> dict[str, Any]:
    """The arguments for a drive of `count` exact measurements, the odometry beginning so long after the first."""
    truth, covariance = drive(0.4), np.diag([0.1, 0.1, np.deg2rad(0.5)]) ** 2
    stamps = truth.stamp_ns[40:-40:10][:count]
    poses, told = truth.interpolate(stamps), with_errors(truth, errors)
    kept = told.stamp_ns >= stamps[0] + missing_s * SECOND
    return {
        "stamps_ns": stamps,
        "odometry": Trajectory(told.stamp_ns[kept], told.poses[kept], None, "odometry"),
        "noise": OdometryNoise(),
        "measurements": [GaussianMixture(np.ones(1), pose[None], covariance[None]) for pose in poses],
        "prior": UniformPrior(poses[0], 5.0, 0.2),
        "initial": Trajectory(stamps, poses, np.repeat(covariance[None], len(stamps), axis=0)),
    }


def test_an_odometry_may_begin_half_a_second_late() -> None:
    """Clock and lead are tried together, up to 0.9 s, and half a second is missing."""
    found = calibrate_odometry(**asked(OdometryCalibration(0.2, 0.2), 40, 0.45))
    assert found.clock_offset_s == pytest.approx(0.2, abs=0.03)
    assert found.heading_lead_s + found.heading_lead_m / SPEED == pytest.approx(0.2, abs=0.03)


def test_a_standstill_told_without_noise_moves_nothing() -> None:
    """10 s of standstill, and no noise by the second."""
    truth, given = drive(0.4), asked(OdometryCalibration(), 60, -1.0)
    poses = truth.poses.copy()
    poses[200:400] = poses[200]
    poses[400:] = se2.compose(se2.compose(poses[200], se2.inverse(poses[400])), poses[400:])
    stands = Trajectory(truth.stamp_ns, poses)
    seen = stands.interpolate(given["stamps_ns"])
    covariance = given["measurements"][0].covariances
    given["odometry"] = Trajectory(stands.stamp_ns, poses, None, "odometry")
    given["noise"] = OdometryNoise(position_m_per_sqrt_s=0.0, heading_rad_per_sqrt_s=0.0)
    given["measurements"] = [GaussianMixture(np.ones(1), pose[None], covariance) for pose in seen]
    given["initial"] = Trajectory(given["stamps_ns"], seen, np.repeat(covariance, len(seen), axis=0))
    given["prior"] = UniformPrior(seen[0], 5.0, 0.2)
    found = calibrate_odometry(**given)
    assert found.clock_offset_s == pytest.approx(0.0, abs=0.02)
    assert found.heading_lead_s + found.heading_lead_m / SPEED == pytest.approx(0.0, abs=0.02)


def test_an_odometry_without_noise_is_not_led_astray() -> None:
    given = asked(OdometryCalibration(), 40, -1.0)
    found = calibrate_odometry(**{**given, "noise": OdometryNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)})
    assert found.clock_offset_s == pytest.approx(0.0, abs=0.01)
    assert found.heading_lead_s + found.heading_lead_m / SPEED == pytest.approx(0.0, abs=0.02)


def test_what_does_not_fit_together_is_refused() -> None:
    given = asked(OdometryCalibration(), 10, -1.0)
    stamps, measurements = given["stamps_ns"], given["measurements"]
    twice = np.where(np.arange(10) == 5, stamps[4], stamps)
    for wrong in (twice, stamps[::-1]):
        with pytest.raises(SkyfixError, match="stamps: expected strictly increasing, got a repeat or a step back"):
            calibrate_odometry(**{**given, "stamps_ns": wrong})
    for count in (0, 7, 11):
        with pytest.raises(SkyfixError, match=f"odometry calibration: expected 10 measurements, got {count}"):
            calibrate_odometry(**{**given, "measurements": (measurements + measurements)[:count]})


def test_no_finite_evidence_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is found where nothing can be compared; a trial that alone has no number is passed over."""
    monkeypatch.setattr("fusion.odometry_calibration._Search.log_evidence", lambda *_: np.nan)
    with pytest.raises(SkyfixError, match="expected a finite evidence of the measurements, got none in any trial"):
        calibrate_odometry(**asked(OdometryCalibration(), 10, -1.0))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("low", "high", "best"), [(-0.6, 0.4, 0.0), (0.4, 2.0, 0.5), (-0.1, 0.6, 0.5), (-1, 2, 0.3)])
def test_trials_without_a_number_are_passed_over(bad: float, low: float, high: float, best: float) -> None:
    """Steps of a half along a parabola with its minimum at 0.3 that has costs in an interval only."""
    step, start = np.array([0.5]), np.zeros(1)
    found = _best_along(step, start, lambda at: (at[0] - 0.3) ** 2 if low < at[0] < high else bad)
    np.testing.assert_allclose(found, best, atol=1e-12)


def test_where_nothing_differs_nothing_moves() -> None:
    np.testing.assert_array_equal(_best_along(np.array([0.5]), np.zeros(1), lambda at: 1.0), 0.0)


def test_a_prior_that_is_very_sure_is_kept_to() -> None:
    given = asked(OdometryCalibration(clock_offset_s=0.2), 10, -1.0)
    found = calibrate_odometry(**given, calibration_prior=CalibrationPrior(clock_offset_s=1e-200))
    assert found.clock_offset_s == 0.0


@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
def test_impossible_priors_are_named(value: float) -> None:
    with pytest.raises(SkyfixError, match=f"calibration prior clock_offset_s: expected > 0, got {value}"):
        CalibrationPrior(clock_offset_s=value)
