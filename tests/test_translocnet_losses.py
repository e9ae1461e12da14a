"""Losses of TransLocNet against dense sums and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from made_translocnet import TINY, noise_batch

from learned.decoder import PoseHeads
from learned.translocnet import TransLocNet
from learned.translocnet_losses import (
    heading_target,
    is_right,
    location_target,
    mean_direction,
    orientation_loss,
    relative_heading,
    truth_in_cells,
    wrapped,
)
from learned.translocnet_output import PoseMaps


def maps_of(location: torch.Tensor, orientation: torch.Tensor) -> PoseMaps:
    """Pose maps with given logits (B, H, W) and (B, K, H, W)."""
    bins = orientation.shape[1]
    heads = PoseHeads(1 + bins, bins)
    with torch.no_grad():
        heads.location.weight.zero_()
        heads.location.weight[0, 0] = 1.0
        heads.orientation.bias.zero_()
        heads.orientation.weight.copy_(torch.cat([torch.zeros(bins, 1), torch.eye(bins)], dim=1))
    return PoseMaps.of(torch.cat([location[:, None], orientation], dim=1), heads)


def test_sparse_orientation_is_dense_orientation() -> None:
    settings = replace(TINY, loss=replace(TINY.loss, orientation_cells=64 * 64))
    torch.manual_seed(0)
    net, batch = TransLocNet(settings), noise_batch(2)
    pose = net(batch.density, batch.picture, batch.prior_yaw).pose
    assert isinstance(pose, PoseMaps)
    share = location_target(truth_in_cells(settings, batch), 64, 1.0 / 0.5)
    logits = pose.heads.orientation(pose.features)  # every cell
    target = heading_target(relative_heading(settings, batch), 72, 2.5)
    dense = -(share.view(2, 64, 64) * (logits.log_softmax(-1) * target[:, None, None, :]).sum(-1)).sum((1, 2)).mean()
    torch.testing.assert_close(net.losses(batch, torch.Generator())["orientation"], dense)
    torch.manual_seed(0)
    few = TransLocNet(TINY).losses(batch, torch.Generator())["orientation"]
    torch.testing.assert_close(few, dense, rtol=0.01, atol=0)
    assert not torch.equal(few, dense)


@pytest.mark.parametrize("cell", [(3, 4), (0, 0), (7, 2)])
def test_soft_argmax_of_one_cell_is_its_middle(cell: tuple[int, int]) -> None:
    location = torch.full((1, 8, 8), -1e4)
    location[0, cell[0], cell[1]] = 0.0
    soft = maps_of(location, torch.zeros(1, 4, 8, 8)).soft_argmax().detach()
    torch.testing.assert_close(soft, torch.tensor([[cell[0] + 0.5, cell[1] + 0.5]]))


def test_soft_argmax_of_a_symmetric_peak_is_unbiased() -> None:
    """The target itself, about any place, has its mean there: also between cells, and to both sides of a middle."""
    truth = torch.tensor([[16.0, 16.0], [15.5, 16.5], [14.3, 17.9], [16.7, 15.1]])
    target = location_target(truth, 32, 2.0)
    soft = maps_of(target.log().view(4, 32, 32), torch.zeros(4, 3, 32, 32)).soft_argmax().detach()
    torch.testing.assert_close(soft, truth, rtol=0, atol=1e-3)
    torch.testing.assert_close(target.sum(dim=1), torch.ones(4))


def test_location_target_has_its_width() -> None:
    target = location_target(torch.tensor([[16.2, 15.9]]), 32, 2.0).view(32, 32)
    middle = torch.arange(32) + 0.5
    assert float((target.sum(1) * (middle - 16.2) ** 2).sum()) == pytest.approx(4.0, rel=1e-3)
    assert float((target.sum(0) * (middle - 15.9) ** 2).sum()) == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize("heading_deg", [0.0, 77.3, -179.8, 120.0])
def test_heading_target_is_about_the_heading_and_has_its_width(heading_deg: float) -> None:
    heading = math.radians(heading_deg)
    target = heading_target(torch.tensor([heading]), 360, 2.5)[0].double()
    centres = torch.arange(360, dtype=torch.float64) * math.radians(1.0)
    away = wrapped(centres - heading)
    assert float(target.sum()) == pytest.approx(1.0, abs=1e-5)
    assert float((target * away).sum()) == pytest.approx(0.0, abs=1e-4)
    assert math.degrees(math.sqrt(float((target * away**2).sum()))) == pytest.approx(2.5, rel=0.02)


def test_orientation_loss_is_least_at_the_target_and_weighs_cells() -> None:
    target = heading_target(torch.tensor([0.3]), 36, 10.0)
    right, flat = target.log()[:, None, :], torch.full((1, 1, 36), -math.log(36))
    entropy = -(target * target.log()).sum()
    share = torch.tensor([[0.25, 0.75]])
    loss = orientation_loss(torch.cat([right, flat], dim=1), share, target)
    torch.testing.assert_close(loss, 0.25 * entropy + 0.75 * torch.tensor(math.log(36)))
    assert float(entropy) < math.log(36)


def test_mean_direction_points_to_the_heading_across_the_seam() -> None:
    heading = torch.tensor([math.radians(-179.5), 0.02, 2.0])
    direction = mean_direction(heading_target(heading, 360, 2.5).log()[:, None, :], torch.ones(3, 1))
    torch.testing.assert_close(
        wrapped(torch.atan2(direction[:, 1], direction[:, 0]) - heading), torch.zeros(3), atol=1e-4, rtol=0
    )
    assert (direction.norm(dim=1) > 0.998).all()
    flat = mean_direction(torch.full((1, 1, 360), -math.log(360)), torch.ones(1, 1))
    assert float(flat.norm()) < 1e-5


def test_regression_has_a_gradient_where_the_heading_is_flat() -> None:
    """An angle of the mean direction would have none, or an infinite one."""
    batch = noise_batch(2)
    torch.manual_seed(0)
    net = TransLocNet(TINY)
    assert net.heads is not None
    torch.nn.init.zeros_(net.heads.orientation.weight)
    torch.nn.init.zeros_(net.heads.orientation.bias)
    loss = net.losses(batch, torch.Generator())["regression"]
    gradient = torch.autograd.grad(loss, net.heads.orientation.bias)[0]
    assert torch.isfinite(gradient).all()
    assert 0.01 < float(gradient.abs().max()) < 100.0


def test_relative_heading_is_from_the_bin_of_the_prior() -> None:
    batch = noise_batch(8)
    step = 2 * math.pi / TINY.yaw_bins
    relative = relative_heading(TINY, batch).double()
    in_bins = (batch.yaw - relative) / step
    torch.testing.assert_close(in_bins, in_bins.round(), rtol=0, atol=1e-5)
    assert float((wrapped(batch.yaw - relative - batch.prior_yaw)).abs().max()) <= step / 2 + 1e-6


def test_right_means_near_in_position_and_heading() -> None:
    location, orientation = torch.zeros(1, 16, 16), torch.zeros(1, 72, 16, 16)
    location[0, 8, 6], orientation[0, 2] = 9.0, 9.0  # 10 degrees
    pose = maps_of(location, orientation)
    best = torch.tensor([[8.5, 6.5]])
    cases = [
        (best, 10.0, True),
        (best + torch.tensor([[3.9, 0.0]]), 10.0, True),  # 1.95 m
        (best + torch.tensor([[0.0, 4.1]]), 10.0, False),
        (best, 14.9, True),
        (best, 4.9, False),
        (best, -170.0, False),
    ]
    for truth, heading_deg, expected in cases:
        heading = torch.tensor([math.radians(heading_deg)])
        assert bool(is_right(replace(TINY, crop_px=16), pose, truth, heading)[0]) == expected


def test_blind_maps_have_the_nll_of_a_uniform_density() -> None:
    torch.manual_seed(0)
    net = TransLocNet(TINY)
    assert net.heads is not None
    for parameter in net.heads.parameters():
        torch.nn.init.zeros_(parameter)
    nll = net.truth_nll(noise_batch(3), torch.Generator())
    torch.testing.assert_close(nll, torch.full((3,), math.log(32.0**2 * 2 * math.pi)), rtol=1e-5, atol=1e-5)
