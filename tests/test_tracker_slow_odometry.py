"""Odometry with a sample a second, or fewer, and filters that leave measurements out: nothing of them is lost."""

import numpy as np
import pytest

from fusion import (
    GaussianLikelihood,
    KalmanFilter,
    MapGrid,
    OdometryIncrement,
    ParticleFilterSettings,
    Tracker,
    TrackerSettings,
    UniformPrior,
)

SECOND = 10**9
GRID = MapGrid(400, 400, 1.0, -200.0, -200.0)
PRIOR = UniformPrior(np.zeros(3), 0.5, 0.02)


@pytest.mark.parametrize("estimator", ["filter", "graph"])
@pytest.mark.parametrize("ahead_s", [0.2, 0.9, 2.0])
def test_beyond_slow_odometry_its_own_velocity_goes_on(estimator, ahead_s):
    one = Tracker.from_prior(PRIOR, 2000, estimator=estimator)
    for second in range(8):
        pose = np.array([10.0 * second, 0.0, 0.0])
        one.add_odometry(second * SECOND, pose)
        one.add_likelihood(second * SECOND, GaussianLikelihood(pose, np.diag([0.04, 0.04, 0.0004]), GRID))
    estimate = one.estimate(7 * SECOND + round(ahead_s * SECOND))
    assert estimate.pose[0] == pytest.approx(70.0 + 10.0 * ahead_s, abs=0.3)
    assert estimate.covariance[0, 0] > (0.8 * ahead_s) ** 2  # known over a second only


def test_beyond_a_single_sample_the_vehicle_may_be_anywhere_within_its_reach():
    one = Tracker.from_prior(PRIOR, 20_000)
    one.add_odometry(0, np.zeros(3))
    spread = np.sqrt(one.estimate(SECOND // 2).covariance[0, 0])
    assert spread == pytest.approx(0.5 * (60.0 * 0.5 + 0.5), rel=0.05)


@pytest.mark.parametrize("estimator", ["filter", "graph", "both"])
def test_there_is_an_answer_however_far_ahead(estimator):
    one = Tracker.from_prior(PRIOR, 500, estimator=estimator)
    for tenth in range(20):
        one.add_odometry(tenth * SECOND // 10, [0.5 * tenth, 0.0, 0.0])
    for ahead_s in (300, 500, 10**6):
        assert one.estimate(ahead_s * SECOND).covariance[0, 0] > 1e6


def test_odometry_slower_than_the_history_is_taken_sample_by_sample_once_it_is_known(tmp_path):
    one = Tracker.from_prior(PRIOR, 500)
    for index in range(20):
        one.add_odometry(round(2.5 * index * SECOND), [5.0 * index, 0.0, 0.0])
        assert one.statistics.withheld == (index if index < 5 else 0)
        if index == 11:
            one.save(tmp_path / "tracker.npz")
            one = Tracker.load(tmp_path / "tracker.npz")
    statistics = one.statistics
    assert (statistics.odometry, statistics.gaps, statistics.dismissed_odometry) == (20, 19, 0)
    estimate = one.estimate()
    assert abs(estimate.pose[0] - 5.0 * 19) < 3.0 * np.sqrt(estimate.covariance[0, 0])
    one.add_odometry(10_000 * SECOND, np.zeros(3))  # a stray stamp
    assert one.statistics.withheld == 1
    now_ns = round(2.5 * 19 * SECOND)
    for tenth in range(1, 31):  # it gets fast
        one.add_odometry(now_ns + tenth * SECOND // 10, [95.0 + 0.2 * tenth, 0.0, 0.0])
    assert one.statistics.dismissed_odometry == 1
    one.add_odometry(now_ns + round(6.0 * SECOND), np.zeros(3))  # which would have been in time before
    assert one.statistics.withheld == 1


def test_measurements_that_are_left_out_do_not_make_the_next_one_fresh():
    def temperatures(every: int) -> list[float]:
        one = Tracker.from_prior(
            UniformPrior(np.zeros(3), 2.0, 0.1),
            5000,
            TrackerSettings(correlation_length_m=6.0),
            ParticleFilterSettings(standstill_m=0.5, standstill_rad=0.05),
        )
        found = []
        for tenth in range(121):
            one.add_odometry(tenth * SECOND // 10, [0.05 * tenth, 0.0, 0.0])
            if tenth % every == 0:
                seen = GaussianLikelihood([0.05 * tenth, 0.0, 0.0], np.diag([0.25, 0.25, 0.01]), GRID)
                arrival = one.add_likelihood(tenth * SECOND // 10, seen)
                found += [measured.temperature for measured in arrival.measured if measured.update.used]
        return found

    often, rarely = temperatures(1), temperatures(10)
    assert len(often) == len(rarely) == 13
    np.testing.assert_allclose(often[1:8], rarely[1:8], rtol=1e-6)


@pytest.mark.parametrize("half_heading_deg", [150.0, 152.0, 175.0])
def test_a_widely_spread_heading_keeps_its_mean(half_heading_deg):
    one = KalmanFilter.from_prior(UniformPrior(np.zeros(3), 5.0, np.deg2rad(half_heading_deg)))
    for step in range(5):
        one.predict(OdometryIncrement(step + 1, np.array([1.0, 0.0, 0.0]), 1e-6 * np.eye(3)))
        estimate = one.estimate(step)
        assert abs(estimate.pose[2]) < 1e-6
        assert estimate.covariance[2, 2] == pytest.approx(np.deg2rad(half_heading_deg) ** 2 / 3.0, rel=1e-3)
