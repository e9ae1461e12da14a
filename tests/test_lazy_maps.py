"""Headings computed where they are asked for are those that are written out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import logsumexp

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned import lazy_maps
from learned.lazy_maps import LazyPoseMaps, search_window
from learned.matcher import SearchRegion

GRID = MapGrid(12, 10, 0.5, 3.0, -7.0)


def example(seed: int = 0, bins: int = 18) -> LazyPoseMaps:
    rng = np.random.default_rng(seed)
    location = 2.0 * rng.standard_normal((12, 10))
    location -= logsumexp(location) + 2 * math.log(0.5)
    features, weight, bias = (rng.standard_normal(s).astype(np.float32) for s in ((12, 10, 4), (bins, 4), (bins,)))
    return LazyPoseMaps(location.astype(np.float32), features, weight, bias, GRID, 0.25)


def poses_about(count: int = 300) -> np.ndarray:
    """Poses in and about the grid, headings several times around."""
    return np.random.default_rng(1).uniform([2.0, -8.0, -9.0], [9.0, 0.0, 9.0], (count, 3))


@pytest.fixture(params=[7, 4096], ids=["several blocks", "one block"], autouse=True)
def block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """How many cells the head is applied to at once must not matter."""
    monkeypatch.setattr(lazy_maps, "_CELLS_AT_ONCE", request.param)


def test_densities_are_those_of_the_maps_written_out() -> None:
    lazy = example()
    maps = lazy.to_maps()
    assert maps.confidence == 0.25
    np.testing.assert_allclose(lazy.log_density(poses_about()), maps.log_density(poses_about()), atol=1e-5)
    np.testing.assert_allclose(lazy.draw_log_density(poses_about()), maps.draw_log_density(poses_about()), atol=1e-5)
    assert lazy.searched_volume == maps.searched_volume
    per_cell = logsumexp(maps.orientation.astype(np.float64), axis=0) + math.log(2 * math.pi / 18)
    np.testing.assert_allclose(per_cell, 0.0, atol=1e-5)


def test_samples_and_modes_are_those_of_the_maps() -> None:
    lazy = example()
    ours, theirs = (m.sample(500, np.random.default_rng(5)) for m in (lazy, lazy.to_maps()))
    assert np.isclose(ours, theirs, atol=1e-6).all(axis=1).mean() > 0.99  # a rounding may move one to the next bin
    np.testing.assert_allclose(lazy.modes(2).means, lazy.to_maps().modes(2).means, atol=1e-4)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0])
def test_tempering_is_that_of_the_maps(temperature: float) -> None:
    lazy = example()
    ours, theirs = lazy.tempered(temperature), lazy.to_maps().tempered(temperature)
    np.testing.assert_allclose(ours.log_density(poses_about()), theirs.log_density(poses_about()), atol=1e-4)


def test_outliers_are_mixed_in() -> None:
    lazy = example()
    mixed = lazy.with_outliers(0.1).log_density(poses_about())
    uniform = -math.log(GRID.area_m2 * 2 * math.pi)
    np.testing.assert_allclose(mixed, np.logaddexp(lazy.log_density(poses_about()) + math.log(0.9), uniform - 2.302585))


def test_volume_is_the_joint_density_given_the_searched_headings() -> None:
    lazy, bins = example(), [16, 17, 0, 1]
    volume = lazy.to_volume(bins)
    joint = (lazy.to_maps().location + lazy.to_maps().orientation[bins]).astype(np.float64)
    expected = joint - logsumexp(joint) - math.log(0.5**2 * 2 * math.pi / 18)
    np.testing.assert_allclose(volume.log_prob[:, :, bins], np.moveaxis(expected, 0, 2), atol=1e-4)
    assert (np.delete(volume.log_prob, bins, axis=2) == volume.floor).all()


def test_uniform_floor_is_that_of_a_filter() -> None:
    """Over all headings: the mixture of the density and of the uniform one, at the cells' middles."""
    lazy = example()
    x, y = GRID.centres()
    poses = np.array([[x[c], y[r], k * 2 * math.pi / 18] for r, c, k in [(0, 0, 0), (3, 7, 5), (11, 9, 17)]])
    volume = lazy.to_volume(list(range(18)), 0.3)
    np.testing.assert_allclose(volume.log_density(poses), lazy.with_outliers(0.3).log_density(poses), atol=1e-4)


def test_within_a_search_region_is_the_density_given_that_region() -> None:
    lazy = example()
    search = SearchRegion(np.array([5.6, -4.2, 0.0]), 1.0)
    part = lazy.within(search)
    for corner in ([4.6, -5.2], [6.6, -3.2]):
        assert part.grid.contains(np.array(corner))
    assert (part.grid.rows, part.grid.cols) == (5, 5)
    assert float(logsumexp(part.location.astype(np.float64))) + 2 * math.log(0.5) == pytest.approx(0.0, abs=1e-5)
    inside = np.array([[5.75, -4.25, 0.3], [5.25, -3.75, 2.0]])  # middles of cells
    shift = part.log_density(inside) - lazy.log_density(inside)
    assert shift[0] == pytest.approx(shift[1], abs=1e-5)
    assert shift[0] > 0


def test_search_window_is_cut_to_the_grid() -> None:
    window = search_window(GRID, SearchRegion(np.array([3.0, -1.0, 0.0]), 2.0))
    assert GRID.offset_of(window) == (0, 0)
    assert (window.rows, window.cols) == (4, 4)
    whole = search_window(GRID, SearchRegion(np.array([5.0, -4.0, 0.0]), 50.0))
    assert whole == GRID
    with pytest.raises(SkyfixError, match="search region: expected some of"):
        search_window(GRID, SearchRegion(np.array([30.0, -4.0, 0.0]), 2.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"location": np.zeros((3, 10), np.float32)}, r"expected \(12, 10\) and \(12, 10, 'C'\), got \(3, 10\)"),
        ({"weight": np.zeros((18, 3), np.float32)}, r"orientation head: expected \(18, 4\), got \(18, 3\)"),
        ({"bias": np.full(18, np.nan, np.float32)}, "expected finite values, got NaN or an infinity"),
    ],
)
def test_bad_parts_are_one_line(change: dict[str, np.ndarray], message: str) -> None:
    lazy = example()
    parts = {name: getattr(lazy, name) for name in ("location", "features", "weight", "bias", "grid")}
    with pytest.raises(SkyfixError, match=message):
        LazyPoseMaps(**{**parts, **change})
