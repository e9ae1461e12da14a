"""The one-channel scan image of TransLocNet: log density, turned to the prior heading, as large as the map crop.

Paper (arXiv 2512.10419): a bird's-eye view of the same scale and size as the map, the vehicle in its middle. Of the
height bands of `learned.bev` those above the ground are added up: one channel that held the ground too would be
saturated by the rings on the road, which are on no map, and walls would drown in them.

The image is turned by the prior heading, so that its axes are the map's but for the error of the prior; only then
does a bias by relative position say anything. The heading that it is turned by is rounded to a heading bin, so that
a distribution over headings relative to it becomes one of the map frame by renumbering the bins.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fusion.errors import SkyfixError
from learned.bev import BANDS_M, GROUND

_LOG_SCALE = 3.0
"""`learned.bev.log_density` divides by it."""


def scan_image(density: Tensor, yaw: Tensor, size: int) -> Tensor:
    """One-channel images (B, 1, size, size) of scans at headings yaw.

    Parameters
    ----------
    density
        (B, bands, n, n) log densities, body frame (see `learned.bev`); n even.
    yaw
        (B,) headings by which to turn, radians.
    size
        Side of the result, even; the scan is cut, or zeros are put around it.

    Raises
    ------
    SkyfixError
        If a shape is wrong or a value is not finite.
    """
    if density.ndim != 4 or density.shape[1] != len(BANDS_M) or density.shape[2] != density.shape[3]:
        raise SkyfixError(f"scan density: expected (B, {len(BANDS_M)}, n, n), got {tuple(density.shape)}")
    if density.shape[-1] % 2 or size % 2:
        raise SkyfixError(f"scan density: expected an even number of cells, got {density.shape[-1]} for {size}")
    if not torch.isfinite(density).all():
        bad = int((~torch.isfinite(density)).sum())
        raise SkyfixError(f"scan density: expected finite values, got {bad} of {density.numel()} not finite")
    above = [band for band in range(len(BANDS_M)) if band != GROUND]
    counts = torch.expm1(_LOG_SCALE * density[:, above].float()).sum(dim=1, keepdim=True)
    margin = (size - density.shape[-1]) // 2
    image = torch.nn.functional.pad((torch.log1p(counts) / _LOG_SCALE).clamp(max=1.0), [margin] * 4)
    return turned(image, yaw)


def turned(images: Tensor, yaw: Tensor) -> Tensor:
    """Turn body-frame images (B, C, n, n) counter-clockwise by yaw (B,) about their middles; zero outside."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    zero = torch.zeros_like(cos)
    # Image axes are (x right, y down): a map-frame offset d is read at R(-yaw) d in the body frame.
    affine = torch.stack([torch.stack([cos, -sin, zero], dim=-1), torch.stack([sin, cos, zero], dim=-1)], dim=1)
    flow = torch.nn.functional.affine_grid(affine.to(images), list(images.shape), align_corners=False)
    return torch.nn.functional.grid_sample(images, flow, mode="bilinear", padding_mode="zeros", align_corners=False)


def heading_bin(yaw: Tensor, bins: int) -> Tensor:
    """Bin (B,) int64, centre at 2 pi k / bins, nearest to a heading (B,) float64, radians."""
    return torch.round(yaw.double() * (bins / (2 * math.pi))).long() % bins
