"""Searching a whole map: against the ordinary vote over the same poses, on a small made-up town."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.two_level import TwoLevelLikelihood
from learned.bev import BevSettings
from learned.hybrid import HybridNet, HybridSettings
from learned.map_lattice import MapLattice, MapSearchSettings
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.map_search import MapSearch
from learned.rotmatch import RotMatch, RotMatchNet, RotMatchSettings
from learned.voting import bin_yaws, rotate_templates, vote
from learned.voting_net import VotingMatcher
from learned.whole_map import search_over

FEATURE_M, TEMPLATE, YAW_BINS = 1.0, 20, 60
MAP = MapGrid(90, 120, 0.5, 5.0, -7.0)
CLOSE = MapSearchSettings(cell_m=3.0, heading_deg=18.0, places=6)
NARROW, WIDE = np.array([2.0, 2.0, np.deg2rad(10.0)]), np.array([10.5, 10.5, np.deg2rad(27.1)])


def scene(lattice: MapLattice, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.float64]]:
    """Smooth random map features, what is seen of them from a pose of the lattice, and that pose."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(3, lattice.window.rows, lattice.window.cols, generator=generator)
    found = torch.nn.functional.avg_pool2d(noise[None], 5, stride=1, padding=2)[0] * 4.0
    row, col, yaw_bin = 40, 47, 13  # template's corner in the window
    seen = found[:, row : row + TEMPLATE, col : col + TEMPLATE]
    body = rotate_templates(seen, torch.tensor([-yaw_bin * 2 * np.pi / YAW_BINS]))[0]
    rows = np.arange(TEMPLATE) - TEMPLATE / 2 + 0.5
    disc = torch.from_numpy((rows[:, None] ** 2 + rows**2 < (TEMPLATE / 2) ** 2).astype(np.float32))
    xy = lattice.window.xy_from_pixel(np.array([row + TEMPLATE / 2, col + TEMPLATE / 2]))
    return found, body * disc * 0.03, np.array([*xy, yaw_bin * 2 * np.pi / YAW_BINS])


def narrow(found: torch.Tensor, scan: torch.Tensor, lattice: MapLattice) -> LikelihoodVolume:
    """The ordinary vote over all fine cells of the map."""
    scores = vote(found, scan, bin_yaws(range(YAW_BINS), YAW_BINS))
    first, side, coarse = lattice.first, lattice.side, lattice.coarse
    used = scores[:, first : first + side * coarse.rows, first : first + side * coarse.cols]
    grid = MapGrid(used.shape[1], used.shape[2], FEATURE_M, lattice.coarse.x0, lattice.coarse.y0)
    return LikelihoodVolume.from_scores(used.permute(1, 2, 0).numpy(), grid)


@pytest.fixture(scope="module")
def lattice() -> MapLattice:
    return MapLattice.over(MAP, FEATURE_M, TEMPLATE, YAW_BINS, 1, CLOSE)


def mass_near(likelihood: LikelihoodVolume | TwoLevelLikelihood, pose: NDArray[np.float64], reach_m: float) -> float:
    drawn = likelihood.sample(40_000, np.random.default_rng(0))
    return float((np.hypot(*(drawn[:, :2] - pose[:2]).T) < reach_m).mean())


def test_the_lattice_covers_the_map_and_its_window_holds_every_template(lattice: MapLattice) -> None:
    grid = lattice.coarse
    assert grid.x0 <= MAP.x0
    assert grid.y0 <= MAP.y0
    assert grid.x0 + grid.width_m >= MAP.x0 + MAP.width_m
    assert grid.y0 + grid.height_m >= MAP.y0 + MAP.height_m
    assert (lattice.side, lattice.turn) == (3, 3)
    assert lattice.first + lattice.side * grid.rows + TEMPLATE - 1 <= lattice.window.rows
    assert lattice.first + lattice.side * grid.cols + TEMPLATE - 1 <= lattice.window.cols


@pytest.mark.parametrize("seed", range(4))
def test_it_has_the_fine_vote_where_it_looks_closely_and_its_mass(lattice: MapLattice, seed: int) -> None:
    found, scan, pose = scene(lattice, seed)
    search = MapSearch(found, lattice, YAW_BINS, 1.0, CLOSE)
    wide, fine = search.likelihood(scan), narrow(found, scan, lattice)
    best = wide.modes(1)
    assert np.hypot(*(best.means[0, :2] - pose[:2])) < 0.6
    # Cell for cell the same up to one constant, which is the mass of all that was not looked at closely.
    cut_rows, cut_cols, cut_bins = wide.cut.T
    offsets = wide.fine[:, 1, 1, 1] - fine.log_prob[3 * cut_rows + 1, 3 * cut_cols + 1, 3 * cut_bins]
    np.testing.assert_allclose(offsets, offsets[0], atol=2e-3)
    assert abs(float(offsets[0])) < 0.1
    assert mass_near(wide, pose, 4.0) == pytest.approx(mass_near(fine, pose, 4.0), abs=0.06)


def test_poses_that_are_asked_about_are_looked_at_closely(lattice: MapLattice) -> None:
    found, scan, _ = scene(lattice)
    search = MapSearch(found, lattice, YAW_BINS, 1.0, CLOSE)
    near = np.array([[20.0, 20.0, -2.0], [1e4, 0.0, 0.0]])
    cells = {tuple(cell) for cell in search.likelihood(scan, near).cut.tolist()}
    row, col = np.floor(lattice.coarse.pixel_from_xy(near[0, :2])).astype(int)
    assert (row, col, round(-2.0 * 20 / (2 * np.pi)) % 20) in cells
    assert len(cells - {tuple(cell) for cell in search.likelihood(scan).cut.tolist()}) <= 27


def test_the_contrast_is_nothing_at_the_right_place_and_much_elsewhere(lattice: MapLattice) -> None:
    for seed in range(4):
        found, scan, pose = scene(lattice, seed)
        search = MapSearch(found, lattice, YAW_BINS, 0.5, CLOSE)
        assert search.contrast(scan, pose, NARROW) == search.contrast(scan, pose, WIDE) == 0.0
        assert search.contrast(scan, pose + [-22.0, 4.0, 0.0], WIDE) > 5.0
        assert search.contrast(scan, pose + [1e4, 0.0, 0.0], WIDE) > 5.0
        # A few metres off, the right place is near in the wide box and not in the narrow one.
        assert search.contrast(scan, pose + [4.0, -4.0, 0.0], WIDE) == 0.0
        assert search.contrast(scan, pose + [4.0, -4.0, 0.0], NARROW) > 5.0


def test_the_contrast_is_nearly_that_of_the_ordinary_vote_over_the_whole_map(lattice: MapLattice) -> None:
    """Few places are looked at closely: what is best near a pose may be missed a little, which adds to the contrast.

    By 0.12 nats of 12 in the mean, at most 1.2.
    """
    excess = []
    for seed in range(4):
        found, scan, pose = scene(lattice, seed)
        search, everywhere = MapSearch(found, lattice, YAW_BINS, 1.0, CLOSE), narrow(found, scan, lattice)
        for offset in ([-22.0, 4.0, 1.0], [15.0, -9.0, -2.0], [-6.0, 18.0, 2.0]):
            elsewhere = pose + offset
            x, y = everywhere.grid.centres()
            yaw = np.arange(YAW_BINS) * 2 * np.pi / YAW_BINS
            about = (np.abs(x - elsewhere[0]) <= WIDE[0])[None, :, None] & (np.abs(y - elsewhere[1]) <= WIDE[1])[
                :, None, None
            ]
            about = about & (np.abs(np.angle(np.exp(1j * (yaw - elsewhere[2])))) <= WIDE[2])
            expected = everywhere.log_prob.max() - everywhere.log_prob.max(where=about, initial=-np.inf)
            excess.append(search.contrast(scan, elsewhere, WIDE) - expected)
    assert min(excess) > -2e-3
    assert np.mean(excess) < 0.3
    assert max(excess) < 2.0


def test_a_prior_of_the_map_counts_as_in_the_ordinary_vote(lattice: MapLattice) -> None:
    found, scan, pose = scene(lattice)
    banned = torch.zeros(lattice.window.rows, lattice.window.cols)
    row, col = lattice.window.pixel_from_xy(pose[:2]).astype(int)
    banned[row - 9 : row + 9, col - 9 : col + 9] = -50.0
    wide = MapSearch(found, lattice, YAW_BINS, 1.0, CLOSE, banned).likelihood(scan)
    assert mass_near(wide, pose, 6.0) < 1e-3


def town() -> MapRaster:
    classes = np.full((MAP.rows * 3, MAP.cols * 2), CLASS_INDEX["grass"], np.uint8)
    rng = np.random.default_rng(0)
    for row, col in rng.integers(0, (MAP.rows * 3 - 30, MAP.cols * 2 - 30), (30, 2)):
        classes[row : row + rng.integers(8, 30), col : col + rng.integers(8, 30)] = CLASS_INDEX["building"]
    return MapRaster.from_classes(MapGrid(*classes.shape, 0.5, -3.0, 11.0), classes)


BEV = BevSettings(half_extent_m=16.0)


def small_rotmatch() -> RotMatch:
    torch.manual_seed(0)
    return RotMatch(RotMatchNet(RotMatchSettings(channels=4, widths=(4, 4, 8, 8), bev=BEV)))


def small_hybrid() -> VotingMatcher[HybridNet]:
    torch.manual_seed(0)
    settings = HybridSettings(channels=4, widths=(4, 4, 8, 8), bev=BEV, attention_heads=2)
    return VotingMatcher("hybrid", HybridNet(settings))


def scan_points() -> NDArray[np.float32]:
    points = np.random.default_rng(1).uniform(-15.0, 15.0, (4000, 4)).astype(np.float32)
    points[:, 2] = np.abs(points[:, 2]) / 4.0 - 1.7
    return points


@pytest.mark.parametrize("make", [small_rotmatch, small_hybrid])
def test_networks_search_a_whole_map_and_the_same_again(make: Callable[[], VotingMatcher]) -> None:
    matcher, raster = make(), town()
    search = search_over(matcher, raster)
    assert search_over(matcher, raster) is search
    first, again = (search.match(scan_points(), -1.7) for _ in range(2))
    np.testing.assert_array_equal(first.fine, again.fine)
    corners = np.array([[raster.grid.x0 + 0.1, raster.grid.y0 + 0.1, 0.0], [*raster.grid.centre_xy, 1.0]])
    assert (first.log_density(corners) > first.floor).all()


def test_a_matcher_with_a_fixed_crop_is_refused_in_one_line() -> None:
    class Fixed:
        name = "translocnet"
        error_correlation_length_m = 1.0

        def match(self, *_: object) -> LikelihoodVolume:
            raise AssertionError

    with pytest.raises(SkyfixError, match=r"whole-map search: expected a matcher that votes .* got translocnet"):
        search_over(Fixed(), town())


def test_a_map_that_is_too_large_is_refused() -> None:
    huge = MapGrid(200_000, 200_000, 0.5, 0.0, 0.0)
    with pytest.raises(SkyfixError, match=r"whole-map search: expected a map of at most .* km\^2, got 10000 km\^2"):
        MapLattice.over(huge, FEATURE_M, TEMPLATE, 360, 1, MapSearchSettings())
