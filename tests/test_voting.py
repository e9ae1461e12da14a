"""Voting: against a direct sum, against a closed form, and turned."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.correlation import correlate, fast_length
from learned.voting import bin_yaws, quarter_turn_groups, rotate_templates, volume_from_scores, vote, yaw_bins_within


def test_correlation_equals_the_direct_sum() -> None:
    generator = torch.Generator().manual_seed(1)
    scene = torch.randn(3, 14, 17, generator=generator)
    templates = torch.randn(2, 3, 6, 8, generator=generator)
    direct = torch.nn.functional.conv2d(scene[None], templates)[0]
    torch.testing.assert_close(correlate(scene, templates), direct, atol=1e-4, rtol=1e-4)


def test_gradients_equal_those_of_the_direct_sum() -> None:
    generator = torch.Generator().manual_seed(3)
    scene = torch.randn(2, 9, 10, generator=generator, dtype=torch.float64, requires_grad=True)
    templates = torch.randn(3, 2, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(correlate, (scene, templates))


@pytest.mark.parametrize("shape", [(19, 19), (17, 22), (23, 14)])
def test_quick_voting_equals_turning_and_correlating_every_heading(shape: tuple[int, int]) -> None:
    """Headings in any order, some of them quarter turns apart, on maps that are not square."""
    generator = torch.Generator().manual_seed(5)
    scene = torch.randn(3, *shape, generator=generator, dtype=torch.float64)
    scan = torch.randn(3, 12, 12, generator=generator, dtype=torch.float64)
    yaws = torch.tensor([30.0, -60.0, 12.5, 210.0, 0.0, 120.0, 90.0, 359.0], dtype=torch.float64).deg2rad()
    direct = torch.nn.functional.conv2d(scene[None], rotate_templates(scan, yaws))[0]
    torch.testing.assert_close(vote(scene, scan, yaws), direct, atol=1e-9, rtol=0)
    with_gradients = vote(scene.requires_grad_(), scan, yaws)
    assert with_gradients.requires_grad
    torch.testing.assert_close(with_gradients.detach(), direct, atol=1e-9, rtol=0)


@pytest.mark.parametrize("bins", [36, 360])
def test_every_heading_of_a_circle_is_turned_with_three_others(bins: int) -> None:
    groups = list(quarter_turn_groups(bin_yaws(range(bins), bins)))
    assert [len(members) for _, members in groups] == [4] * (bins // 4)
    for yaw, members in groups:
        assert -1e-5 < yaw < math.pi / 2 - 1e-3
        for index, turns in members:
            apart = yaw + turns * math.pi / 2 - index * 2 * math.pi / bins
            assert abs(apart) < 1e-6


@given(st.integers(1, 2000))
def test_fast_lengths_hold_the_map_and_have_small_factors(least: int) -> None:
    length = fast_length(least)
    assert least <= length <= 2 * least + 8
    for factor in (2, 3, 5, 7, 11, 13):
        while length % factor == 0:
            length //= factor
    assert length == 1


def test_template_larger_than_the_map_is_refused() -> None:
    with pytest.raises(SkyfixError, match="no larger than"):
        correlate(torch.zeros(1, 4, 4), torch.zeros(1, 1, 6, 6))
    with pytest.raises(SkyfixError, match=r"no larger than the map's \(4, 7\), got \(6, 6\)"):
        vote(torch.zeros(1, 4, 7), torch.zeros(1, 6, 6), torch.zeros(1))


@pytest.mark.parametrize("turns", range(4))
def test_quarter_turns_are_exact(turns: int) -> None:
    image = torch.randn(2, 10, 10, generator=torch.Generator().manual_seed(2))
    turned = rotate_templates(image, torch.tensor([turns * math.pi / 2]))[0]
    torch.testing.assert_close(turned, torch.rot90(image, turns, dims=(1, 2)), atol=1e-4, rtol=1e-4)


@given(
    yaw_deg=st.floats(-180, 180),
    shift=st.tuples(st.integers(-8, 8), st.integers(-8, 8)),
)
def test_a_landmark_is_found_where_it_is(yaw_deg: float, shift: tuple[int, int]) -> None:
    """A blob ahead and one to the left of the vehicle fix position, heading, axes and signs at once."""
    yaw = math.radians(yaw_deg)
    size, n = 72, 40
    row0, col0 = size / 2 + shift[0], size / 2 + shift[1]

    def blob(rows: int, row: float, col: float) -> torch.Tensor:
        r = torch.arange(rows)[:, None] + 0.5
        c = torch.arange(rows)[None] + 0.5
        return torch.exp(-((r - row) ** 2 + (c - col) ** 2) / (2 * 1.5**2))

    ahead, left = 12.0, 8.0
    scan = blob(n, n / 2, n / 2 + ahead) + blob(n, n / 2 - left, n / 2)
    cos, sin = math.cos(yaw), math.sin(yaw)
    scene = blob(size, row0 - ahead * sin, col0 + ahead * cos) + blob(size, row0 - left * cos, col0 - left * sin)
    yaws = torch.tensor([yaw + math.radians(d) for d in (-40.0, -20.0, 0.0, 20.0, 40.0)])
    scores = vote(scene[None], scan[None], yaws)
    best = np.unravel_index(int(scores.argmax()), tuple(scores.shape))
    assert best == (2, round(row0 - n / 2), round(col0 - n / 2))


@given(centre=st.floats(-7, 7), half=st.floats(0.02, 4), bins=st.sampled_from([36, 72, 360]))
def test_yaw_bins_are_those_within_the_range(centre: float, half: float, bins: int) -> None:
    chosen = yaw_bins_within(centre, half, bins)
    distance = np.abs((np.arange(bins) * 2 * np.pi / bins - centre + np.pi) % (2 * np.pi) - np.pi)
    step = 2 * math.pi / bins
    assert len(set(chosen)) == len(chosen)
    if half >= math.pi - step / 2:
        assert len(chosen) == bins
    else:
        assert distance[chosen].max() <= max(half, step / 2) + 1e-6
        assert (np.delete(distance, chosen) > half - 1e-6).all()


def test_volume_lies_where_the_scores_were_taken() -> None:
    """A template of n pixels in a map of m votes for the m - n + 1 pixel corners in the middle."""
    map_grid = MapGrid(20, 24, 0.5, 100.0, -50.0)
    bins = [3, 4]
    scores = torch.zeros(2, 20 - 8 + 1, 24 - 8 + 1)
    scores[1, 2, 5] = 9.0
    volume = volume_from_scores(scores, bins, 36, map_grid)
    row, col, yaw_bin = np.unravel_index(int(volume.log_prob.argmax()), volume.log_prob.shape)
    xs, ys = volume.grid.centres()
    expected = map_grid.xy_from_pixel((2 + 4, 5 + 4))
    assert yaw_bin == 4
    np.testing.assert_allclose((xs[col], ys[row]), expected)
    assert volume.log_prob[:, :, 5].max() == pytest.approx(volume.floor)
    np.testing.assert_allclose(bin_yaws(bins, 36), np.radians([30.0, 40.0]), rtol=1e-6)
