"""Where scans are looked for: wide until the start is settled, narrow while the filter explains what it sees."""

import numpy as np
import pytest

from fusion import se2
from fusion.estimate import Estimate
from fusion.prior import UniformPrior
from learned.matcher import SearchRegion
from sequences.search import Phase, SearchPlan
from sequences.track_settings import TrackSettings

SETTINGS = TrackSettings("wheels")
FORWARD = np.array([10.0, 0.0, 0.0])


def estimate(sigma_m: float = 0.3, sigma_rad: float = 0.01) -> Estimate:
    covariance = np.diag([sigma_m**2, (0.5 * sigma_m) ** 2, sigma_rad**2])
    return Estimate(0, np.array([1.0, 2.0, 0.3]), covariance, None, 100.0, 0.0, 0.0)


def record(plan: SearchPlan, nats: float, lost_score: float = 0.0, times: int = 1) -> None:
    """Measurements that the prediction explains by so much better than a random pose of the search."""
    search = SearchRegion(np.zeros(3), 10.0, 0.5)
    for _ in range(times):
        plan.record(search, nats - np.log(20.0**2 * 1.0), lost_score)


def settled(prior: UniformPrior) -> SearchPlan:
    plan = SearchPlan(prior, SETTINGS)
    record(plan, 3.0, times=3)
    return plan


@pytest.mark.parametrize("half_heading_deg", [5.0, 10.0, 45.0, 120.0, 180.0])
def test_until_settled_a_search_covers_wherever_the_start_may_have_led(half_heading_deg: float) -> None:
    prior = UniformPrior(np.array([50.0, -20.0, 2.5]), 15.0, np.deg2rad(half_heading_deg))
    plan = SearchPlan(prior, SETTINGS)
    starts = prior.sample(4000, np.random.default_rng(0))
    moved = np.zeros(3)
    for delta in [FORWARD, np.array([8.0, 1.0, 0.6]), np.array([5.0, 0.0, -1.2])]:
        region = plan.region(None if moved[0] == 0.0 else estimate())
        poses = se2.compose(starts, moved)
        assert np.abs(poses[:, :2] - region.centre[:2]).max() <= region.half_extent_m
        assert np.abs(se2.wrap(poses[:, 2] - region.centre[2])).max() <= region.half_heading_rad + 1e-9
        plan.move(delta)
        moved = se2.compose(moved, delta)


def test_a_start_that_was_not_settled_in_time_is_looked_for_about_the_filter() -> None:
    prior = UniformPrior(np.zeros(3), 20.0, np.pi)
    plan = SearchPlan(prior, SETTINGS)
    for _ in range(4):
        plan.move(FORWARD)
        assert plan.region(estimate()).half_extent_m > 24.0
    plan.move(FORWARD)  # 50 m: more than the start may grow by
    region = plan.region(estimate())
    assert plan.phase is Phase.LOST
    np.testing.assert_array_equal(region.centre, estimate().pose)
    assert (region.half_extent_m, region.half_heading_rad) == (24.0, np.pi)


def test_a_settled_search_is_as_wide_as_the_filter_is_unsure_within_bounds() -> None:
    plan = settled(UniformPrior(np.zeros(3), 20.0, np.deg2rad(10.0)))
    for sigma, expected in [(0.1, 12.0), (5.0, 17.5), (50.0, 24.0)]:
        assert plan.region(estimate(sigma_m=sigma)).half_extent_m == pytest.approx(expected)
    for sigma, expected in [(0.001, np.deg2rad(6.0)), (0.1, 0.35), (2.0, np.pi)]:
        assert plan.region(estimate(sigma_rad=sigma)).half_heading_rad == pytest.approx(expected)


def test_three_agreements_in_a_row_settle_the_start() -> None:
    plan = SearchPlan(UniformPrior(np.zeros(3), 20.0, np.pi), SETTINGS)
    record(plan, 3.0, times=2)
    record(plan, 0.5)  # neither here nor there
    record(plan, 3.0, times=2)
    record(plan, 3.0, lost_score=0.9)  # explained, but the filter itself says it is lost
    record(plan, 3.0, times=2)
    assert plan.phase is Phase.START
    record(plan, 3.0)
    assert plan.phase is Phase.TRACK


@pytest.mark.parametrize(("nats", "lost_score"), [(-0.5, 0.0), (4.0, 0.8)])
def test_three_disagreements_in_a_row_lose_the_vehicle_and_three_agreements_find_it(
    nats: float, lost_score: float
) -> None:
    plan = settled(UniformPrior(np.zeros(3), 20.0, np.pi))
    record(plan, nats, lost_score, times=2)
    record(plan, 2.0)
    record(plan, nats, lost_score, times=2)
    assert plan.phase is Phase.TRACK
    record(plan, nats, lost_score)
    assert plan.phase is Phase.LOST
    region = plan.region(estimate())
    assert (region.half_extent_m, np.rad2deg(region.half_heading_rad)) == pytest.approx((24.0, 45.0))
    record(plan, 3.0, times=3)
    assert plan.phase is Phase.TRACK
