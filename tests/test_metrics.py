"""Errors in the vehicle's frame, and the numbers of metrics.json."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import se2
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.metrics import (
    after_first_quarter,
    correlation_length,
    distance_along,
    drift,
    summarise,
    vehicle_frame_errors,
)

ANGLE = st.floats(-np.pi, np.pi)
METRES = st.floats(-100.0, 100.0)


@pytest.mark.parametrize("yaw_deg", [0.0, 35.0, 90.0, 125.0, 180.0, -145.0, -90.0, -35.0])
@pytest.mark.parametrize(
    ("ahead", "left"), [(2.0, 0.5), (-2.0, 0.5), (-2.0, -0.5), (2.0, -0.5), (0.0, 1.0), (1.0, 0.0)]
)
def test_ahead_is_longitudinal_and_left_is_lateral_at_every_heading(yaw_deg: float, ahead: float, left: float) -> None:
    yaw = np.deg2rad(yaw_deg)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    leftward = np.array([-np.sin(yaw), np.cos(yaw)])
    truth = np.array([[10.0, -4.0, yaw]])
    estimate = truth.copy()
    estimate[0, :2] += ahead * forward + left * leftward
    longitudinal, lateral, heading = vehicle_frame_errors(truth, estimate)
    assert longitudinal[0] == pytest.approx(ahead)
    assert lateral[0] == pytest.approx(left)
    assert heading[0] == pytest.approx(0.0)


def test_a_vehicle_heading_north_errs_ahead_in_y_and_left_in_minus_x() -> None:
    truth = np.array([[0.0, 0.0, np.pi / 2]])
    longitudinal, lateral, _ = vehicle_frame_errors(truth, np.array([[-3.0, 5.0, np.pi / 2]]))
    assert (longitudinal[0], lateral[0]) == pytest.approx((5.0, 3.0))


def test_the_truth_gives_the_axes_not_the_estimate() -> None:
    truth = np.array([[0.0, 0.0, 0.0]])
    longitudinal, lateral, heading = vehicle_frame_errors(truth, np.array([[4.0, 1.0, np.pi / 2]]))
    assert (longitudinal[0], lateral[0], heading[0]) == pytest.approx((4.0, 1.0, np.pi / 2))


def test_heading_errors_wrap() -> None:
    truth = np.array([[0.0, 0.0, np.deg2rad(179.0)], [0.0, 0.0, np.deg2rad(-179.0)]])
    estimate = np.array([[0.0, 0.0, np.deg2rad(-179.0)], [0.0, 0.0, np.deg2rad(179.0)]])
    np.testing.assert_allclose(np.rad2deg(vehicle_frame_errors(truth, estimate)[2]), [2.0, -2.0])


@given(x=METRES, y=METRES, yaw=ANGLE, dx=METRES, dy=METRES, dyaw=ANGLE, motion_yaw=ANGLE)
def test_errors_do_not_depend_on_where_and_how_the_drive_lies_on_the_map(
    x: float, y: float, yaw: float, dx: float, dy: float, dyaw: float, motion_yaw: float
) -> None:
    truth, estimate = np.array([[x, y, yaw]]), np.array([[x + dx, y + dy, yaw + dyaw]])
    motion = np.array([[dy, -x, motion_yaw]])
    before = vehicle_frame_errors(truth, estimate)
    after = vehicle_frame_errors(se2.compose(motion, truth), se2.compose(motion, estimate))
    np.testing.assert_allclose(after[0], before[0], atol=1e-9)
    np.testing.assert_allclose(after[1], before[1], atol=1e-9)
    np.testing.assert_allclose(se2.wrap(after[2] - before[2]), 0.0, atol=1e-9)
    assert np.hypot(before[0], before[1]) == pytest.approx(np.hypot(dx, dy), abs=1e-9)


def test_summary_of_known_errors() -> None:
    truth = np.zeros((4, 3))
    truth[:, 2] = np.pi / 2  # heading north: x is to the right, y ahead
    estimate = truth.copy()
    estimate[:, 0] = [0.0, 0.5, -2.0, 6.0]
    estimate[:, 1] = [3.5, 0.0, 0.5, 0.5]
    estimate[:, 2] += np.deg2rad([0.5, -2.0, 4.0, 10.0])
    summary = summarise(truth, estimate)
    position = np.hypot(estimate[:, 0], estimate[:, 1])
    assert summary["position_error_m"]["mean"] == pytest.approx(position.mean(), abs=1e-6)
    assert summary["position_error_m"]["median"] == pytest.approx(np.median(position), abs=1e-6)
    assert summary["position_error_m"]["rmse"] == pytest.approx(np.sqrt((position**2).mean()), abs=1e-6)
    assert summary["position_error_m"]["max"] == pytest.approx(position.max(), abs=1e-6)
    assert summary["heading_error_deg"] == {"mean": 4.125, "median": 3.0, "max": 10.0}
    assert summary["lateral_recall"] == {"1": 0.5, "3": 0.75, "5": 0.75}
    assert summary["longitudinal_recall"] == {"1": 0.75, "3": 0.75, "5": 1.0}
    assert summary["heading_recall"] == {"1": 0.25, "3": 0.5, "5": 0.75}
    assert summary["frames"] == 4
    assert "nees" not in summary
    json.dumps(summary, allow_nan=False)


def test_a_truthful_covariance_covers_as_much_as_it_claims() -> None:
    rng = np.random.default_rng(3)
    n = 4000
    root = np.array([[0.6, 0.0, 0.0], [0.3, 0.4, 0.0], [0.01, 0.02, 0.03]])
    truth = np.column_stack([rng.uniform(-50, 50, (n, 2)), rng.uniform(-np.pi, np.pi, n)])
    estimate = truth + rng.normal(size=(n, 3)) @ root.T
    covariances = np.repeat((root @ root.T)[None], n, axis=0)
    honest = summarise(truth, estimate, covariances)
    # Deviations: of the mean of n chi-square(3) values sqrt(6 / n) = 0.039, of a fraction sqrt(.95 * .05 / n) = 0.0034.
    assert honest["nees"]["mean"] == pytest.approx(3.0, abs=0.16)
    assert honest["nees"]["dof"] == 3
    assert honest["nees"]["coverage95"] == pytest.approx(0.95, abs=0.014)
    assert honest["ellipse95"] == pytest.approx(0.95, abs=0.014)
    boastful = summarise(truth, estimate, covariances / 4.0)
    assert boastful["nees"]["mean"] == pytest.approx(12.0, abs=0.64)
    assert boastful["ellipse95"] < 0.6


def test_summary_of_nothing_is_refused() -> None:
    with pytest.raises(SkyfixError, match="at least one frame"):
        summarise(np.zeros((0, 3)), np.zeros((0, 3)))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_errors_of_what_is_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(SkyfixError, match="estimate: expected finite"):
        vehicle_frame_errors(np.zeros((1, 3)), np.array([[0.0, bad, 0.0]]))


def _line(n: int = 41) -> Trajectory:
    poses = np.column_stack([np.arange(n, dtype=float), np.zeros(n), np.zeros(n)])
    return Trajectory(np.arange(n, dtype=np.int64), poses)


def test_drift_compares_quarters_of_the_way_and_frees_odometry_of_its_start() -> None:
    truth = _line()
    growing = Trajectory(
        truth.stamp_ns, truth.poses + np.column_stack([np.zeros((41, 1)), np.arange(41) / 10, np.zeros(41)])
    )
    turned = np.array([[7.0, 9.0, 1.0]])  # an odometry frame of its own, or a start that was wrong
    odometry = Trajectory(truth.stamp_ns, se2.compose(turned, truth.poses * [1.1, 1.0, 1.0]))
    result = drift(truth, growing, odometry)
    assert result["first_quarter_mean_m"] == pytest.approx(np.mean(np.arange(11)) / 10)
    assert result["last_quarter_mean_m"] == pytest.approx(np.mean(np.arange(30, 41)) / 10)
    assert result["odometry_final_error_m"] == pytest.approx(4.0)


@pytest.mark.parametrize("length_m", [4.0, 10.0])
def test_the_length_over_which_single_shots_repeat_an_error_is_found(length_m: float) -> None:
    """Errors of an Ornstein-Uhlenbeck process, one every 2 m of a curve, on the vehicle's axes; one in 20 is wild."""
    rng, count = np.random.default_rng(0), 2000
    repeated = np.exp(-2.0 / length_m)
    noise = rng.normal(size=(count, 3)) * [1.0, 0.5, 0.02]
    errors = noise.copy()
    for i in range(1, count):
        errors[i] = repeated * errors[i - 1] + np.sqrt(1.0 - repeated**2) * noise[i]
    errors[::20, :2] += rng.uniform(-20.0, 20.0, (count // 20, 2))
    truth = np.zeros((count, 3))
    for i in range(1, count):
        truth[i] = se2.compose(truth[i - 1], np.array([2.0, 0.0, 0.01]))
    found = correlation_length(truth, se2.compose(truth, errors))
    assert found == pytest.approx(length_m, rel=0.25)
    assert correlation_length(truth[:10], truth[:10]) is None


def test_the_first_quarter_is_one_of_the_way_not_of_the_time() -> None:
    along = np.concatenate([np.zeros(20), np.arange(1.0, 21.0)])  # stands still for half of the time
    poses = np.column_stack([along, np.zeros((40, 2))])
    truth = Trajectory(np.arange(40, dtype=np.int64), poses)
    np.testing.assert_allclose(distance_along(truth.poses), along)
    assert after_first_quarter(truth, truth).poses[0, 0] == 5.0
