"""Attention and the Fourier branch: what they must not change under shifts and turns, and what the bias means."""

import pytest
import torch

from learned.attention import BidirectionalCrossAttention, ChannelSpatialAttention, CrossAttention, RelativePositionBias
from learned.fourier import FourierBranch, annulus_means


def test_bias_depends_on_the_offset_alone_and_differs_between_offsets() -> None:
    side = 4
    bias = RelativePositionBias(2, side)
    with torch.no_grad():
        bias.table.copy_(torch.arange(bias.table.numel()).view_as(bias.table))
    full = bias().detach().unflatten(2, (side, side)).unflatten(1, (side, side))  # heads, query row, col, key row, col
    torch.testing.assert_close(full[:, 1:, :, 1:, :], full[:, :-1, :, :-1, :], rtol=0, atol=0)
    torch.testing.assert_close(full[:, :, 1:, :, 1:], full[:, :, :-1, :, :-1], rtol=0, atol=0)
    assert full[0].unique().numel() == (2 * side - 1) ** 2
    assert float(full[0, 2, 1, 0, 3]) == float(bias.table.detach()[0, 2 - 0 + side - 1, 1 - 3 + side - 1])


def test_attention_goes_where_the_bias_points() -> None:
    """With a bias for one offset alone, a query reads the value that lies there."""
    torch.manual_seed(0)
    side, layer = 5, CrossAttention(8, 2, 5)
    with torch.no_grad():
        layer.bias.table.zero_()
        layer.bias.table[:, side - 1 + 1, side - 1 - 2] = 200.0  # the key one row above and two columns to the right
        keys = torch.randn(1, side * side, 8)
        read = layer(torch.zeros(1, side * side, 8), keys)
        one_key = layer(torch.zeros(1, side * side, 8), keys[:, [1 * side + 3]].expand(-1, side * side, -1))
    query = 2 * side + 1
    torch.testing.assert_close(read[0, query], one_key[0, query], rtol=1e-5, atol=1e-5)
    assert (read[0, query] - one_key[0, query + 1]).abs().max() < 1e-5  # the same value read, wherever it is read from
    assert (read[0, query] - read[0, query + 1]).abs().max() > 1e-3


def test_turning_grids_and_bias_together_turns_the_answer() -> None:
    torch.manual_seed(1)
    side, attention = 4, BidirectionalCrossAttention(8, 4, 4)
    a, b = torch.randn(2, 3, 8, side, side)
    first = attention(a, b)
    with torch.no_grad():
        for layer in (attention.map_from_scan, attention.scan_from_map):
            layer.bias.table.copy_(torch.rot90(layer.bias.table.clone(), 1, (1, 2)))
    second = attention(torch.rot90(a, 1, (2, 3)), torch.rot90(b, 1, (2, 3)))
    for before, after in zip(first, second, strict=True):
        torch.testing.assert_close(torch.rot90(before, 1, (2, 3)), after, rtol=1e-4, atol=1e-5)


def test_a2b_is_read_by_the_map_and_b2a_by_the_scan() -> None:
    torch.manual_seed(2)
    attention = BidirectionalCrossAttention(8, 2, 3)
    a, b = torch.randn(2, 1, 8, 3, 3)
    a.requires_grad_()
    a2b, b2a = attention(a, b)
    # The map's own cell reaches its answer past the attention, the scan's answer sees each cell by attention alone.
    own = torch.autograd.grad(a2b[0, :, 1, 1].sum(), a, retain_graph=True)[0]
    assert float(own[0, :, 1, 1].abs().sum()) > 0
    assert float(own[0, :, 0, 0].abs().sum()) == 0
    assert (torch.autograd.grad(b2a[0, :, 1, 1].sum(), a)[0].abs().sum(dim=1) > 0).all()


def test_cbam_scales_down_by_a_factor_a_channel_times_a_factor_a_place() -> None:
    torch.manual_seed(3)
    cbam = ChannelSpatialAttention(16)
    x = torch.randn(2, 16, 9, 9)
    ratio = cbam(x) / x
    assert ((ratio > 0) & (ratio < 1)).all()
    by_channel = ratio[:, :, 4, 4]
    torch.testing.assert_close(ratio, by_channel[:, :, None, None] * (ratio[:, :1] / by_channel[:, :1, None, None]))


def test_the_spectrum_ignores_shifts_and_turns_with_the_image() -> None:
    torch.manual_seed(4)
    x = torch.randn(1, 3, 8, 8)
    branch = FourierBranch(3, 8, pool_rotations=False)
    spectrum = branch.spectrum(x)
    torch.testing.assert_close(branch.spectrum(x.roll((3, -2), (2, 3))), spectrum, rtol=1e-4, atol=1e-5)
    turned = branch.spectrum(torch.rot90(x, 1, (2, 3)))
    assert (turned - spectrum).abs().max() > 0.1  # the paper says invariant
    expected = torch.log1p(torch.fft.fft2(x).abs() / 8)
    torch.testing.assert_close(spectrum, expected, rtol=1e-4, atol=1e-5)


def test_the_pooled_spectrum_ignores_turns_as_well() -> None:
    torch.manual_seed(5)
    x = torch.randn(1, 3, 8, 8)
    branch = FourierBranch(3, 8, pool_rotations=True)
    pooled = branch.spectrum(x)
    for turns in (1, 2, 3):
        torch.testing.assert_close(branch.spectrum(torch.rot90(x, turns, (2, 3))), pooled, rtol=1e-4, atol=1e-5)
    assert (branch.spectrum(torch.randn(1, 3, 8, 8)) - pooled).abs().max() > 0.1


@pytest.mark.parametrize("side", [4, 7, 16])
def test_annulus_means_are_a_projection_that_keeps_the_mean(side: int) -> None:
    means = annulus_means(side)
    torch.testing.assert_close(means, means.T)
    torch.testing.assert_close(means @ means, means)
    torch.testing.assert_close(means.sum(dim=1), torch.ones(side * side))
    assert int(torch.linalg.matrix_rank(means)) < side * side


def test_the_branch_keeps_the_spatial_features() -> None:
    """They are concatenated, not replaced: with the spectrum's weights at zero they pass through unchanged."""
    branch = FourierBranch(2, 4, pool_rotations=False)
    with torch.no_grad():
        branch.mix.weight.zero_()
        branch.mix.bias.zero_()
        branch.mix.weight[:, :2, 0, 0] = torch.eye(2)
    x = torch.randn(1, 2, 4, 4)
    torch.testing.assert_close(branch(x), x)
