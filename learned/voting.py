"""Rotated-template voting: score every pose of a window by correlating a scan's features with the map's.

A scan's feature image, seen from above with the vehicle at its centre, is rotated to each candidate heading and
correlated with the map's feature image; the correlation at a shift is the score of the pose that the shift stands
for. It is exhaustive over position and heading, differentiable, and costs one FFT a channel and heading (OrienterNet,
Sarlin et al., CVPR 2023, section 3.3, uses the same principle; Barsan et al., CoRL 2018, equation 3, is its origin).

The vehicle stands on the corner between the template's four middle pixels, so candidate positions are pixel corners
of the map window, and the grid of the scores is half a pixel off the map's.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.correlation import MapCorrelator, correlate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_SAME_YAW_RAD = 2e-6
_ROTATED_AT_ONCE = 16


def rotate_templates(features: Tensor, yaws: Tensor) -> Tensor:
    """Rotate body-frame feature images counter-clockwise to each heading, about their centre.

    Parameters
    ----------
    features
        (C, n, n), n even; body x along +columns, body y against rows.
    yaws
        (R,) radians.

    Returns
    -------
    (R, C, n, n), bilinear, zero outside.
    """
    channels, size, _ = features.shape
    cos, sin = torch.cos(yaws), torch.sin(yaws)
    # Image axes are (x right, y down): a map-frame offset d is read at R(-yaw) d in the body frame.
    row_x = torch.stack([cos, -sin, torch.zeros_like(cos)], dim=-1)
    row_y = torch.stack([sin, cos, torch.zeros_like(cos)], dim=-1)
    affine = torch.stack([row_x, row_y], dim=1).to(features.dtype)
    flow = torch.nn.functional.affine_grid(affine, [len(yaws), channels, size, size], align_corners=False)
    batch = features.expand(len(yaws), -1, -1, -1)
    return torch.nn.functional.grid_sample(batch, flow, mode="bilinear", padding_mode="zeros", align_corners=False)


def vote(map_features: Tensor, scan_features: Tensor, yaws: Tensor) -> Tensor:
    """Score (R, rows, cols) of headings `yaws` (R,) and all positions.

    Where a gradient is wanted all headings are scored side by side; else one after the other, which is much quicker
    and takes little memory (see `learned.correlation`).
    """
    if torch.is_grad_enabled() and (map_features.requires_grad or scan_features.requires_grad):
        return correlate(map_features, rotate_templates(scan_features, yaws))
    correlator, found = MapCorrelator(map_features), [Tensor()] * len(yaws)
    groups = list(quarter_turn_groups(yaws))
    for start in range(0, len(groups), _ROTATED_AT_ONCE):
        block = groups[start : start + _ROTATED_AT_ONCE]
        angles = torch.tensor([yaw for yaw, _ in block], dtype=torch.float64, device=yaws.device)
        turned = rotate_templates(scan_features, angles)
        for template, (_, members) in zip(turned, block, strict=True):
            scores = correlator.scores(template, [turns for _, turns in members])
            for (index, _), score in zip(members, scores, strict=True):
                found[index] = score
    return torch.stack(found)


def quarter_turn_groups(yaws: Tensor) -> Iterator[tuple[float, list[tuple[int, int]]]]:
    """Headings (R,) that are quarter turns apart, together: a yaw, and (index, turns) of each.

    Headings within the rounding of float32 count as one; a group that rounding tears apart costs time alone.
    """
    quarter = math.pi / 2
    turns_of = [math.floor((yaw + _SAME_YAW_RAD) / quarter) for yaw in yaws.tolist()]
    parts = sorted((yaw - turns_of[i] * quarter, turns_of[i], i) for i, yaw in enumerate(yaws.tolist()))
    group: list[tuple[int, int]] = []
    first = 0.0
    for yaw, turns, index in parts:
        if group and yaw - first > _SAME_YAW_RAD:
            yield first, group
            group = []
        if not group:
            first = yaw
        group.append((index, turns))
    if group:
        yield first, group


def prior_scores(prior: Tensor, template_size: int) -> Tensor:
    """What a map's unary log-prior (H, W) adds to the votes (rows, cols) of a template of (n, n) cells.

    Candidate positions are corners of cells, so each gets the mean of the four cells around it.
    """
    corners = torch.nn.functional.avg_pool2d(prior[None, None], 2, stride=1)[0, 0]
    inset = template_size // 2 - 1
    rows, cols = (side - template_size + 1 for side in prior.shape)
    return corners[inset : inset + rows, inset : inset + cols]


def volume_from_scores(
    scores: Tensor, bins: list[int], yaw_bins: int, map_grid: MapGrid, stride: int = 1
) -> LikelihoodVolume:
    """Make a likelihood of the scores (R, rows, cols) of some yaw bins; the other bins count as not evaluated.

    Parameters
    ----------
    scores
        What `vote` gave, already divided by a temperature.
    bins
        The bin of each of the R headings.
    yaw_bins
        Number of bins on the circle.
    map_grid
        The map window that was matched.
    stride
        Map pixels a feature cell.
    """
    _, rows, cols = scores.shape
    mpp = map_grid.metres_per_pixel * stride
    inset = (map_grid.width_m - cols * mpp) / 2
    grid = MapGrid(rows, cols, mpp, map_grid.x0 + inset, map_grid.y0 + inset)
    volume = np.zeros((rows, cols, yaw_bins), dtype=np.float32)
    volume[:, :, bins] = scores.permute(1, 2, 0).numpy()
    valid = np.zeros(yaw_bins, dtype=np.bool_)
    valid[bins] = True
    return LikelihoodVolume.from_scores(volume, grid, valid=valid)


def yaw_bins_within(centre_rad: float, half_range_rad: float, bins: int) -> list[int]:
    """Return the indices of the yaw bins (centre of bin k at 2 pi k / bins) that lie within a range about a centre."""
    step = 2 * math.pi / bins
    if half_range_rad >= math.pi - step / 2:
        return list(range(bins))
    first = math.ceil((centre_rad - half_range_rad) / step - 1e-9)
    last = math.floor((centre_rad + half_range_rad) / step + 1e-9)
    if last < first:
        first = last = round(centre_rad / step)
    return [k % bins for k in range(first, last + 1)]


def bin_yaws(indices: Sequence[int], bins: int) -> Tensor:
    """Yaw (R,) float32 of each bin index."""
    return torch.tensor(indices, dtype=torch.float32) * (2 * math.pi / bins)
