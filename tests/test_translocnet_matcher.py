"""TransLocNet as a matcher: frames and headings, search regions, checkpoints; it learns a handful of samples."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_translocnet import TINY, landmark_batch, landmarks, noise_batch

from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.architectures import ARCHITECTURES
from learned.bev import BevSettings
from learned.calibration import Calibration
from learned.checkpoint import load_checkpoint, save_network
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion, error_correlation_length_m
from learned.translocnet import TransLocNet
from learned.translocnet_losses import true_pose_nll
from learned.translocnet_matcher import TransLocNetMatcher
from learned.translocnet_output import PoseMaps
from learned.translocnet_settings import TransLocNetSettings

CITY_GRID = MapGrid(200, 180, 0.5, 100.0, -40.0)


def city() -> MapRaster:
    """A map of noise, larger than the crop."""
    picture = np.random.default_rng(0).integers(0, 255, (200, 180, 3)).astype(np.uint8)
    return MapRaster(CITY_GRID, None, picture)


def scan_of(seed: int = 0) -> np.ndarray:
    """Points all around, from the ground to the facades."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-12, 12, (2000, 2)), np.full(2000, -1.7), np.zeros(2000)])
    posts = np.column_stack([rng.uniform(-12, 12, (300, 2)), rng.uniform(-0.5, 2, 300), np.zeros(300)])
    return np.concatenate([ground, posts]).astype(np.float32)


def tiny_matcher(settings: TransLocNetSettings = TINY, calibration: Calibration | None = None) -> TransLocNetMatcher:
    torch.manual_seed(0)
    return TransLocNetMatcher(TransLocNet(settings), calibration)


@pytest.mark.parametrize("prior_deg", [0.0, 63.0, 141.0, -118.0, -37.0, 179.9])
def test_headings_are_answered_in_the_map_frame(prior_deg: float) -> None:
    """A head that says 'two bins to the left of the prior' everywhere."""
    matcher = tiny_matcher(replace(TINY, uniform_floor=0.0))
    assert matcher.net.heads is not None
    with torch.no_grad():
        matcher.net.heads.orientation.weight.zero_()
        matcher.net.heads.orientation.bias.zero_()
        matcher.net.heads.orientation.bias[2] = 12.0
    search = SearchRegion(np.array([145.0, 12.0, math.radians(prior_deg)]), 5.0, math.radians(25))
    for volume in (
        matcher.match(scan_of(), -1.7, city(), search),
        matcher.maps(scan_of(), -1.7, city(), search).to_volume(),
    ):
        expected = math.radians(5.0 * round(prior_deg / 5.0) + 10.0)
        assert abs(se2.wrap(volume.bin_peaks.argmax() * 2 * math.pi / 72 - expected)) < 1e-6


def test_positions_are_answered_in_the_map_frame() -> None:
    """The network's cells, put on the map by hand."""
    matcher = tiny_matcher()
    search = SearchRegion(np.array([147.3, 5.2, 0.5]), 6.0, math.radians(20))
    lazy = matcher.likelihood(scan_of(), -1.7, city(), search)
    assert (lazy.grid.rows, lazy.grid.cols, lazy.grid.metres_per_pixel) == (64, 64, 0.5)
    row0, col0 = CITY_GRID.offset_of(lazy.grid)  # on the map's pixels
    assert np.abs(lazy.grid.centre_xy - search.centre[:2]).max() <= 0.25 + 1e-9
    best = np.unravel_index(lazy.location.argmax(), lazy.location.shape)
    x, y = lazy.grid.xy_from_pixel(np.array(best) + 0.5)
    assert x == pytest.approx(100.0 + 0.5 * (col0 + best[1] + 0.5))
    assert y == pytest.approx(-40.0 + 0.5 * (200 - row0 - best[0] - 0.5))


def test_volume_covers_the_search_and_nothing_else() -> None:
    search = SearchRegion(np.array([146.1, 8.3, 3.1]), 6.0, math.radians(12))
    for settings in (TINY, replace(TINY, probabilistic=False)):
        volume = tiny_matcher(settings).match(scan_of(), -1.7, city(), search)
        corners = search.centre[:2] + 6.0 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        assert volume.grid.contains(corners).all()
        assert volume.grid.width_m <= 2 * 6.0 + 1.0
        bins = np.flatnonzero(volume.bin_peaks > volume.floor) * 2 * math.pi / 72
        assert len(bins) == pytest.approx(5, abs=1)
        assert np.abs(se2.wrap(bins - 3.1)).max() < math.radians(12.01)
        mass = np.exp(volume.log_prob.astype(np.float64))[volume.log_prob > volume.floor].sum() * volume.cell_volume
        assert mass == pytest.approx(1.0, abs=1e-4)


def test_lazy_maps_and_maps_written_out_agree() -> None:
    matcher = tiny_matcher(calibration=Calibration(temperature=1.6))
    search = SearchRegion(np.array([146.1, 8.3, -2.0]), 5.0, math.radians(15))
    lazy = matcher.likelihood(scan_of(), -1.7, city(), search)
    maps = matcher.maps(scan_of(), -1.7, city(), search)
    assert maps.grid.rows <= 22
    assert 0.0 <= maps.confidence == lazy.confidence <= 1.0
    poses = search.centre + np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [4.0, 4.0, np.pi]
    shift = maps.log_density(poses) - lazy.log_density(poses)
    np.testing.assert_allclose(shift, shift[0], atol=1e-4)  # the density given the region
    raw = tiny_matcher()
    volume = raw.match(scan_of(), -1.7, city(), SearchRegion(search.centre, 5.0))
    floor = raw.maps(scan_of(), -1.7, city(), search).with_outliers(TINY.uniform_floor)
    x, y = maps.grid.centres()
    at_cells = np.array([[x[3], y[5], 10 * 2 * math.pi / 72], [x[12], y[15], 50 * 2 * math.pi / 72]])
    np.testing.assert_allclose(volume.log_density(at_cells), floor.log_density(at_cells), atol=1e-4)


@pytest.mark.parametrize("probabilistic", [True, False])
@pytest.mark.parametrize("half_heading_deg", [15.0, 180.0])
def test_a_calibrated_answer_is_the_raw_one_calibrated(probabilistic: bool, half_heading_deg: float) -> None:
    """What is fitted on raw likelihoods is what the matcher does to them."""
    settings = replace(TINY, probabilistic=probabilistic)
    assert ARCHITECTURES["translocnet"].factored
    assert ARCHITECTURES["translocnet-compact"].factored
    calibration = Calibration(temperature=1.4, heading_concentration=0.6)
    search = SearchRegion(np.array([146.1, 8.3, -2.0]), 5.0, math.radians(half_heading_deg))
    raw = tiny_matcher(settings).match(scan_of(), -1.7, city(), search)
    ready = tiny_matcher(settings, calibration).match(scan_of(), -1.7, city(), search)
    expected = calibration.applied(raw)
    np.testing.assert_allclose(ready.log_prob, expected.log_prob, atol=1e-5)
    assert (ready.grid, ready.floor) == (expected.grid, expected.floor)
    tempered = Calibration(temperature=1.4).applied(raw)
    assert np.abs(ready.log_prob - tempered.log_prob)[raw.log_prob > raw.floor].max() > 0.01


def test_errors_repeat_over_more_where_no_building_is_shown() -> None:
    matcher = tiny_matcher(calibration=Calibration(error_correlation_length_m=8.0, bare_map_correlation_length_m=31.0))
    roads = MapRaster.from_classes(CITY_GRID, np.zeros((200, 180), np.uint8))
    assert error_correlation_length_m(matcher, city()) == 8.0  # a photograph
    assert error_correlation_length_m(matcher, roads) == 31.0


def test_maps_give_the_headings_their_concentration() -> None:
    """Over all headings, before any floor: the same as of the joint density written out."""
    calibration = Calibration(temperature=1.4, heading_concentration=2.5)
    search = SearchRegion(np.array([146.1, 8.3, -2.0]), 5.0)
    ready = tiny_matcher(calibration=calibration).likelihood(scan_of(), -1.7, city(), search)
    raw = tiny_matcher().likelihood(scan_of(), -1.7, city(), search)
    everything = list(range(TINY.yaw_bins))
    expected = calibration.applied(raw.to_volume(everything))
    np.testing.assert_allclose(ready.to_volume(everything).log_prob, expected.log_prob, atol=2e-4)
    np.testing.assert_array_equal(ready.location, raw.tempered(1.4).location)


def test_nll_of_training_is_that_of_the_filters_likelihood() -> None:
    """Over the whole crop and circle, without a temperature, both are the same density."""
    matcher = tiny_matcher()
    batch = noise_batch(1)
    grid = MapGrid(64, 64, 0.5, 10.0, 20.0)
    output = matcher.net(batch.density, batch.picture, batch.prior_yaw)
    assert isinstance(output.pose, PoseMaps)
    search = SearchRegion(np.array([26.0, 36.0, float(batch.prior_yaw[0])]), 16.0)
    with torch.inference_mode():
        lazy = matcher._lazy_maps(output, output.pose, grid, search)
        nll = float(true_pose_nll(TINY, output.pose, batch)[0])
    volume = lazy.to_volume(list(range(72)), TINY.uniform_floor)
    truth = np.array([*grid.xy_from_pixel([float(batch.row[0]), float(batch.col[0])]), float(batch.yaw[0])])
    assert -volume.log_density(truth[None])[0] == pytest.approx(nll, abs=1e-4)


def test_direct_regression_is_a_gaussian_on_the_map() -> None:
    """East and north, and a heading relative to the prior's bin."""
    matcher = tiny_matcher(replace(TINY, probabilistic=False, uniform_floor=0.0))
    assert matcher.net.regression is not None
    with torch.no_grad():
        for parameter in matcher.net.regression.parameters():
            parameter.zero_()
        matcher.net.regression.mlp[2].bias.copy_(torch.tensor([0.1, -0.05, math.cos(0.1), math.sin(0.1)]))
    search = SearchRegion(np.array([146.0, 8.0, 2.0]), 12.0, math.radians(40))
    volume = matcher.match(scan_of(), -1.7, city(), search)
    mean = volume.modes(1).means[0]
    np.testing.assert_allclose(mean[:2], [148.0, 7.0], atol=0.3)  # 20 m a unit
    assert abs(se2.wrap(mean[2] - (round(2.0 / math.radians(5)) * math.radians(5) + 0.1))) < math.radians(1)
    with pytest.raises(SkyfixError, match="expected a network with a probabilistic decoder, got direct regression"):
        matcher.likelihood(scan_of(), -1.7, city(), search)
    batch = noise_batch(1)
    output = matcher.net(batch.density, batch.picture, batch.prior_yaw)
    at_mean = replace(
        batch,
        row=torch.tensor([32.0 + 2.0]).double(),
        col=torch.tensor([32.0 + 4.0]).double(),
        yaw=torch.round(batch.prior_yaw / math.radians(5)) * math.radians(5) + 0.1,
    )
    peak = -math.log((2 * math.pi) ** 1.5 * 3.0**2 * math.radians(5.0))
    settings = matcher.net.settings
    assert -float(true_pose_nll(settings, output.pose, at_mean).detach()) == pytest.approx(peak, abs=1e-4)


def test_maps_at_a_coarser_scale_lie_where_they_should() -> None:
    """With pooling by two a cell is a metre, and the crop is the same square of the map."""
    matcher = tiny_matcher(replace(TINY, crop_px=128, pool=2))
    search = SearchRegion(np.array([146.0, 8.0, 0.0]), 10.0, 0.2)
    lazy = matcher.likelihood(scan_of(), -1.7, city(), search)
    assert (lazy.grid.rows, lazy.grid.metres_per_pixel) == (64, 1.0)
    assert np.abs(lazy.grid.centre_xy - search.centre[:2]).max() <= 0.25 + 1e-9


def test_checkpoints_come_back(tmp_path: Path) -> None:
    for name in ("translocnet", "translocnet-compact"):
        architecture = ARCHITECTURES[name]
        settings = architecture.settings_type(**{
            field: getattr(TINY, field)
            for field in ("bev", "crop_px", "backbone", "channels", "decoder_widths", "yaw_bins", "embedding")
        }, pool=1)  # fmt: skip
        torch.manual_seed(1)
        net = architecture.build(settings)
        save_network(tmp_path / f"{name}.safetensors", architecture, net, Calibration(1.3, 8.0), {})
        again = load_checkpoint(tmp_path / f"{name}.safetensors")
        assert again.net.settings == settings
        assert again.error_correlation_length_m == 8.0
        search = SearchRegion(np.array([146.0, 8.0, 1.0]), 5.0, 0.2)
        first, second = (
            m.match(scan_of(), -1.7, city(), search) for m in (architecture.matcher(net, Calibration(1.3, 8.0)), again)
        )
        np.testing.assert_allclose(first.log_prob, second.log_prob, atol=1e-5)


def test_bad_requests_are_one_line() -> None:
    matcher = tiny_matcher()
    with pytest.raises(SkyfixError, match=r"^search: expected a half extent of at most 16 m, got 17$"):
        matcher.match(scan_of(), -1.7, city(), SearchRegion(np.array([146.0, 8.0, 0.0]), 17.0))
    broken = scan_of()
    broken[5, 1] = np.nan
    with pytest.raises(SkyfixError, match=r"^scan: expected finite coordinates, got 1 of 2300 points"):
        matcher.match(broken, -1.7, city(), SearchRegion(np.array([146.0, 8.0, 0.0]), 5.0))


def test_it_learns_a_handful_of_samples_with_headings_in_all_quadrants() -> None:
    """The slow test here (15 s of one core): trained on truths in pixels, asked in metres of another frame."""
    yaws = [math.radians(d) for d in (25.0, 115.0, -155.0, -65.0)]
    errors = [math.radians(d) for d in (7.0, -8.0, 5.0, -3.0)]
    settings = replace(TINY, bev=BevSettings(6.0, 0.5), crop_px=32, yaw_bins=360)
    torch.manual_seed(1)
    net, batch = TransLocNet(settings), landmark_batch(yaws, errors, 32, 24)
    optimizer = torch.optim.Adam(net.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, total_steps=160)
    generator = torch.Generator().manual_seed(0)
    for _ in range(160):
        optimizer.zero_grad()
        net.losses(batch, generator)["total"].backward()
        optimizer.step()
        schedule.step()
    matcher = TransLocNetMatcher(net)
    grid = MapGrid(32, 32, 0.5, 1000.0, -500.0)
    for seed, (yaw, error) in enumerate(zip(yaws, errors, strict=True)):
        counts, picture, (row, col) = landmarks(yaw, seed, 32, 24)
        search = SearchRegion(np.array([*grid.centre_xy, yaw + error]), 7.0, math.radians(12))
        volume = matcher.match_counts(counts, MapRaster(grid, None, picture), search)
        found, truth = volume.modes(1).means[0], np.array([*grid.xy_from_pixel([row, col]), yaw])
        assert np.hypot(*(found - truth)[:2]) < 0.5
        assert abs(se2.wrap(found[2] - yaw)) < math.radians(1.0)
    with torch.no_grad():
        assert float(net.truth_nll(batch, generator).max()) < 1.0  # of a uniform density: 7.4
