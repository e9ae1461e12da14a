"""Feature images scaled about a point, and a map seen from a pose: what aligning scan and map asks for.

Cells are counted from edge to edge (a centre is at +0.5), as everywhere. A scale s says that what is d metres away in
the scan lies s d metres away on the map.
"""

from __future__ import annotations

import torch
from torch import Tensor


def scaled_scans(images: Tensor, scales: Tensor) -> Tensor:
    """Scan images (B, C, n, n) as they look on maps of scales (B,), about their centres; zero outside."""
    zero = torch.zeros_like(scales)
    affine = _affine(1 / scales, zero, zero, zero, 1 / scales, zero)
    return _sampled(images, affine, images.shape[-2:])


def scaled_maps(images: Tensor, row: Tensor, col: Tensor, scales: Tensor) -> Tensor:
    """Map images (B, C, H, W) enlarged by scales (B,) about points (B,) that stay where they are; zero outside."""
    across, down = _normalised(images, row, col)
    zero, shrink = torch.zeros_like(across), (1 / scales).to(across)
    affine = _affine(shrink, zero, across * (1 - shrink), zero, shrink, down * (1 - shrink))
    return _sampled(images, affine, images.shape[-2:])


def seen_from(images: Tensor, row: Tensor, col: Tensor, yaw: Tensor, scales: Tensor, size: int) -> Tensor:
    """Map images (B, C, H, W) in the body frames of vehicles: (B, C, size, size), zero outside the map.

    Parameters
    ----------
    row, col
        (B,) where the vehicles stand, continuous cells of the map.
    yaw
        (B,) headings, radians.
    scales
        (B,) of the maps; the result has the scans' scale.
    size
        Cells of the body-frame image, which covers what a scan image of as many cells does.
    """
    height, width = images.shape[-2:]
    across, down = _normalised(images, row, col)
    cos, sin, scales = torch.cos(yaw).to(across), torch.sin(yaw).to(across), scales.to(across)
    wide, high = scales * size / width, scales * size / height
    # Image axes (x right, y down): body offset (u, v) lies at column + cos u + sin v, row - sin u + cos v of the map.
    affine = _affine(wide * cos, wide * sin, across, -high * sin, high * cos, down)
    return _sampled(images, affine, (size, size))


def _normalised(images: Tensor, row: Tensor, col: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows in the coordinates of `grid_sample`: -1 and 1 at the edges of the image."""
    height, width = images.shape[-2:]
    return (2 * col / width - 1).to(images), (2 * row / height - 1).to(images)


def _affine(*entries: Tensor) -> Tensor:
    """Matrices (B, 2, 3) of six entries (B,), row by row."""
    return torch.stack(entries, dim=-1).unflatten(-1, (2, 3))


def _sampled(images: Tensor, affine: Tensor, size: tuple[int, ...]) -> Tensor:
    flow = torch.nn.functional.affine_grid(affine, [*images.shape[:2], *size], align_corners=False)
    return torch.nn.functional.grid_sample(images, flow, mode="bilinear", padding_mode="zeros", align_corners=False)
