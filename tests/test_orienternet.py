"""OrienterNet's LiDAR variant: the score is the paper's, gradients reach it all, and it finds poses that it learned."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from landmark_scenes import (
    BEV,
    BLIND_NLL,
    QUADRANTS,
    QUICK,
    assert_a_batch_is_the_sum_of_its_parts,
    assert_checkpoint_round_trip,
    assert_finds,
    assert_gradients_reach_everything,
    assert_refuses_bad_images,
    batch_of,
    fit,
    matched,
    scene,
)

from fusion.errors import SkyfixError
from learned.orienternet import ARCHITECTURE, OrienterNet, OrienterNetMatcher, OrienterNetSettings
from learned.voting import prior_scores, rotate_templates

TINY = OrienterNetSettings(4, 4, (8, 8, 8, 8), (8, 8, 8, 8), BEV, QUICK)


def net_of(settings: OrienterNetSettings = TINY, seed: int = 0) -> OrienterNet:
    torch.manual_seed(seed)
    return OrienterNet(settings)


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_features_lie_on_cells_of_the_stride(stride: int) -> None:
    net = net_of(replace(TINY, stride=stride))
    batch = batch_of([scene(0), scene(1)])
    features = net.features(batch.density, batch.picture)
    assert features.scan.shape == (2, 4, 64 // stride, 64 // stride)
    assert features.map.shape == (2, 4, 96 // stride, 96 // stride)
    assert features.prior is not None
    assert features.prior.shape == (2, 96 // stride, 96 // stride)
    scores = net.pose_scores(batch.density[0], batch.picture[0], torch.tensor([0.0, 1.0]))
    assert scores.shape == (2, 32 // stride + 1, 32 // stride + 1)


def test_the_score_is_the_papers_average_over_the_view() -> None:
    """Equation 1 cell by cell: the mean of map features times confidence-weighted view features, plus the prior."""
    net = net_of()
    batch = batch_of([scene(2)])
    yaw = torch.tensor([0.7])
    with torch.no_grad():
        scores = net.pose_scores(batch.density[0], batch.picture[0], yaw)[0]
        neural_map, prior = net.neural_map(batch.picture)
        view, confidence = net.neural_bev(batch.density)
        turned = rotate_templates((view * confidence)[0], yaw)[0]
        scale = float(net.log_scale.exp())
        for row, col in ((0, 0), (3, 8), (5, 2)):
            under = neural_map[0, :, row : row + 16, col : col + 16]
            mean = float((under * turned).sum()) / 16**2
            around = float(prior[0, row + 7 : row + 9, col + 7 : col + 9].mean())
            assert float(scores[row, col]) == pytest.approx(scale * mean + around, rel=1e-3, abs=1e-4)


def test_the_prior_belongs_to_the_corner_that_a_vote_stands_for() -> None:
    prior = torch.zeros(10, 12)
    prior[5:7, 4:6] = 8.0
    scores = prior_scores(prior, 4)
    assert scores.shape == (7, 9)
    # Vote (i, j) stands for the corner (i + 2, j + 2); the four cells around the corner (6, 5) are set.
    assert torch.nonzero(scores == 8.0).tolist() == [[4, 3]]


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_gradients_reach_every_parameter(stride: int) -> None:
    batch = batch_of([scene(0), scene(1)])
    assert_gradients_reach_everything(net_of(replace(TINY, stride=stride)), batch)
    assert_gradients_reach_everything(net_of(replace(TINY, stride=stride)), batch_of([scene(3)]))


def test_a_batch_is_the_sum_of_its_parts() -> None:
    assert_a_batch_is_the_sum_of_its_parts(net_of(), batch_of([scene(seed) for seed in range(3)]))


def test_learns_scenes_and_finds_their_poses_in_all_quadrants() -> None:
    scenes = [scene(seed, yaw) for seed, yaw in enumerate(QUADRANTS)]
    net = net_of(replace(TINY, stride=2))
    totals = fit(net, batch_of(scenes), 16)
    assert totals[-1] < BLIND_NLL - 5.0
    for one in scenes:
        assert_finds(OrienterNetMatcher(net, yaw_bins=72), one, metres=1.0, degrees=5.0)


def test_an_unsure_view_leaves_the_prior() -> None:
    """Without confidence anywhere the likelihood is the map's prior, the same for all headings."""
    net = net_of()
    with torch.no_grad():
        net.scan_head.bias[-1] = -100.0
    volume = matched(OrienterNetMatcher(net, yaw_bins=8), scene(1))
    assert float(abs(volume.log_prob - volume.log_prob[:, :, :1]).max()) < 1e-4
    assert float(volume.log_prob.std()) > 1e-3


def test_bad_images_and_settings_are_refused() -> None:
    net = net_of()
    assert_refuses_bad_images(net, OrienterNetMatcher(net), scene(0))
    with pytest.raises(SkyfixError, match="stride: expected one of"):
        net_of(replace(TINY, stride=3))
    with pytest.raises(SkyfixError, match="multiple of 16 pixels, got 56"):
        net_of(replace(TINY, stride=8, bev=replace(BEV, half_extent_m=14.0)))


def test_checkpoints_round_trip(tmp_path: Path) -> None:
    assert_checkpoint_round_trip(ARCHITECTURE, net_of(seed=5), scene(1), tmp_path)


def test_a_longer_reach_keeps_what_a_cell_is_worth() -> None:
    """More cells to average over must not dilute the votes: the factor of a cell's vote stays."""
    near = net_of()
    far = near.reaching(24.0)
    factors = [float(net.log_scale.detach().exp()) / (net.bev.size / net.stride) ** 2 for net in (near, far)]
    assert factors[0] == pytest.approx(factors[1], rel=1e-5)
    assert math.isclose(far.settings.bev.half_extent_m, 24.0)
