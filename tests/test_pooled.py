"""Pooled matchers: the weighted geometric mean of densities, on the first one's cells."""

from dataclasses import dataclass

import numpy as np
import pytest

from fusion import GaussianMixture, LikelihoodVolume, MapGrid, SkyfixError, se2
from learned.geometric import GeometricMatcher
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.matcher import (
    MapMatcher,
    SearchRegion,
    error_correlation_length_m,
    largest_half_extent_m,
    load_matcher,
)
from learned.pooled import PooledMatcher
from learned.rotmatch import RotMatch
from learned.whole_map import search_over

MAP = MapRaster.from_classes(
    MapGrid(400, 400, 0.5, -100.0, -100.0), np.full((400, 400), CLASS_INDEX["grass"], np.uint8)
)
SEARCH = SearchRegion(np.array([2.0, -1.0, 0.3]), 10.0, np.pi)
POINTS = np.zeros((1, 4), np.float32)


@dataclass
class Told:
    """A matcher that answers with a mixture, whatever it is asked; of bins within `half_yaw`."""

    mixture: GaussianMixture
    cell_m: float = 0.5
    bins: int = 72
    half_yaw: float = np.pi
    error_correlation_length_m: float = 3.0
    largest_half_extent_m: float = 50.0
    name: str = "told"

    def match(self, points, ground_z, map_raster, search):
        side = round(2 * search.half_extent_m / self.cell_m)
        grid = MapGrid(side, side, self.cell_m, *(search.centre[:2] - search.half_extent_m))
        x, y = grid.centres()
        yaw = np.arange(self.bins) * 2.0 * np.pi / self.bins
        poses = np.stack(np.meshgrid(y, x, yaw, indexing="ij"), axis=-1)[..., [1, 0, 2]]
        scores = self.mixture.log_density(poses.reshape(-1, 3)).reshape(poses.shape[:3])
        valid = np.abs(se2.wrap(yaw - search.centre[2])) <= self.half_yaw
        return LikelihoodVolume.from_scores(np.maximum(scores, -200.0), grid, valid=valid)


def gaussian(mean, sigmas=(1.0, 1.5, 0.2)):
    return GaussianMixture(np.ones(1), np.asarray(mean)[None], (np.diag(sigmas) ** 2)[None])


def pooled(matchers, weights=None):
    return PooledMatcher(matchers, weights).match(POINTS, -1.7, MAP, SEARCH)


@pytest.mark.parametrize("weights", [None, (3.0, 1.0)])
def test_of_two_gaussians_it_is_the_gaussian_between(weights):
    """Precisions are averaged, and means by precision: closed form, on the volume's own moments."""
    first, second = np.array([3.0, -2.0, 0.4]), np.array([1.0, 0.5, 0.1])
    wide, narrow = np.array([1.6, 1.2, 0.25]), np.array([1.0, 1.1, 0.18])
    volume = pooled([Told(gaussian(first, wide)), Told(gaussian(second, narrow))], weights)
    share = 0.5 if weights is None else 0.75
    precision = share / wide**2 + (1.0 - share) / narrow**2
    mean = (share * first / wide**2 + (1.0 - share) * second / narrow**2) / precision
    [found], [covariance] = volume.modes(1).means, volume.modes(1).covariances
    np.testing.assert_allclose(found, mean, atol=0.03)
    np.testing.assert_allclose(np.diagonal(covariance), 1.0 / precision, rtol=0.06)


def test_of_one_matcher_it_is_its_answer_and_of_two_alike_too():
    one = Told(gaussian([3.0, -2.0, 0.4]), half_yaw=0.5)
    alone = one.match(POINTS, -1.7, MAP, SEARCH)
    for matchers in ([one], [one, one, one]):
        np.testing.assert_allclose(pooled(matchers).log_prob, alone.log_prob, atol=1e-4)


def test_a_mistake_of_one_is_put_right_by_the_other():
    """Each is surer of a wrong place of its own than of the right one, which both know."""
    right, wrong, other = [3.0, -2.0, 0.4], [-5.0, 4.0, 2.0], [8.0, 6.0, -2.0]
    sigmas = np.repeat((np.diag([0.8, 0.8, 0.1]) ** 2)[None], 2, axis=0)
    matchers = [Told(GaussianMixture(np.array([0.4, 0.6]), np.array([right, bad]), sigmas)) for bad in (wrong, other)]
    alone = [matcher.match(POINTS, -1.7, MAP, SEARCH).modes(1).means[0] for matcher in matchers]
    assert all(np.hypot(*(mean - right)[:2]) > 5.0 for mean in alone)
    assert np.hypot(*(pooled(matchers).modes(1).means[0] - right)[:2]) < 0.5


def test_cells_of_another_size_are_read_where_the_firsts_are():
    fine, coarse = Told(gaussian([3.0, -2.0, 0.4])), Told(gaussian([3.0, -2.0, 0.4]), cell_m=1.0, bins=120)
    volume = pooled([fine, coarse])
    alone = fine.match(POINTS, -1.7, MAP, SEARCH)
    assert (volume.grid, volume.log_prob.shape) == (alone.grid, alone.log_prob.shape)
    near = alone.log_prob > alone.log_prob.max() - 4.0
    np.testing.assert_allclose(volume.log_prob[near], alone.log_prob[near], atol=0.25)


def test_what_was_not_searched_stays_so():
    volume = pooled([Told(gaussian([3.0, -2.0, 0.4]), half_yaw=0.5), Told(gaussian([3.0, -2.0, 0.4]))])
    searched = (volume.log_prob > volume.floor).any(axis=(0, 1))
    yaw = np.arange(72) * 2.0 * np.pi / 72
    np.testing.assert_array_equal(searched, np.abs(se2.wrap(yaw - SEARCH.centre[2])) <= 0.5)


def test_bounds_are_those_of_the_tightest():
    pair = PooledMatcher([Told(gaussian([0.0, 0.0, 0.0])), Told(gaussian([0.0, 0.0, 0.0]), largest_half_extent_m=20.0)])
    assert largest_half_extent_m(pair) == 20.0
    assert PooledMatcher([GeometricMatcher()]).largest_half_extent_m == np.inf
    pair.matchers[1].error_correlation_length_m = 9.0
    assert pair.error_correlation_length_m == 9.0
    assert error_correlation_length_m(pair, MAP) == 9.0
    pair.matchers[0].error_correlation_length_on = lambda map_raster: 30.0 if map_raster is MAP else 1.0
    assert error_correlation_length_m(pair, MAP) == 30.0


def test_the_shipped_pair_is_loaded_by_name_and_searches_whole_maps_as_rotmatch_does():
    shipped = load_matcher("pooled")
    bare = MapRaster.from_classes(MAP.grid, np.full((MAP.grid.rows, MAP.grid.cols), CLASS_INDEX["road"], np.uint8))
    assert [error_correlation_length_m(each, bare) for each in (shipped, load_matcher("rotmatch"))] == [25.0, 25.0]
    assert isinstance(shipped, PooledMatcher)
    assert [matcher.name for matcher in shipped.matchers] == ["rotmatch", "hybrid"]
    np.testing.assert_allclose(shipped.shares, [2.0 / 3.0, 1.0 / 3.0])
    assert search_over(shipped, MAP) is shipped.matchers[0].over_map(MAP)
    with pytest.raises(SkyfixError, match="expected a matcher that votes over any map"):
        search_over(PooledMatcher([Told(gaussian([0.0, 0.0, 0.0]))]), MAP)
    with pytest.raises(SkyfixError, match="backend"):
        load_matcher("pooled", "openvino")


@pytest.mark.parametrize(
    ("count", "weights"), [(0, None), (2, (1.0,)), (2, (1.0, 0.0)), (1, (np.nan,)), (1, (np.inf,)), (1, (-1.0,))]
)
def test_weights_that_are_none_are_refused(count, weights):
    with pytest.raises(SkyfixError, match=f"pooled matcher: expected matchers and a positive weight each, got {count}"):
        PooledMatcher([Told(gaussian([0.0, 0.0, 0.0]))] * count, weights)


def test_on_real_scans_it_makes_no_large_mistake(shared_data):
    """KITTI-360, 8 scans with the heading unknown: no error beyond 5 m, and in the mean none above RotMatch's."""
    from sequences.evaluate import evaluate_single_shot
    from sequences.registry import open_sequence
    from sequences.shot_protocol import ShotProtocol

    drive = open_sequence(shared_data("kitti360_0009"))
    matchers: dict[str, MapMatcher] = {"pooled": PooledMatcher.shipped(), "rotmatch": RotMatch.shipped()}
    found = evaluate_single_shot(drive, matchers, ShotProtocol(20.0, 180.0, 8))["methods"]
    assert found["pooled"]["position_error_m"]["max"] < 5.0
    assert found["pooled"]["position_error_m"]["mean"] < found["rotmatch"]["position_error_m"]["mean"] + 0.1
