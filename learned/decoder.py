"""Neck, decoder and heads of TransLocNet (arXiv 2512.10419).

The location head gives a logit a cell of the map, the orientation head K logits at a cell. The latter is a 1 x 1
convolution whose full output would take 94 MB a sample at 256 x 256 cells and 360 bins, so it is applied to single
cells: to those near the truth in training, to those that are asked for when filtering.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learned.attention import ChannelSpatialAttention
from learned.backbone import BackboneSettings, convolution


class Neck(nn.Module):
    """The three deepest stages at the resolution of the middle one, mixed; or the deepest alone (single scale)."""

    def __init__(self, settings: BackboneSettings, channels: int, multi_scale: bool) -> None:
        super().__init__()
        widths = settings.widths[1:] if multi_scale else settings.widths[3:]
        self.lateral = nn.ModuleList([nn.Conv2d(width, channels, 1) for width in widths])
        self.mix = nn.Sequential(convolution(channels * len(widths), channels), convolution(channels, channels))
        self.attention = ChannelSpatialAttention(channels)

    def forward(self, levels: list[Tensor]) -> Tensor:
        """Levels of a `ResidualEncoder` -> (B, channels, side, side)."""
        size = levels[3].shape[-2:]
        scales = [
            nn.functional.interpolate(lateral(level), size=size, mode="bilinear", align_corners=False)
            for lateral, level in zip(self.lateral, levels[-len(self.lateral) :], strict=True)
        ]
        return self.attention(self.mix(torch.cat(scales, dim=1)))


class Fusion(nn.Module):
    """[aerial, a2b] -> one map; what the scan read of the map (b2a) enters as its mean over the vehicle's grid.

    b2a has the vehicle's axes and origin, so adding it cell by cell to maps on the aerial grid would mean nothing.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = convolution(2 * channels, channels)
        self.second = convolution(channels, channels)

    def forward(self, map_features: Tensor, beside: Tensor, vehicle_grid: Tensor | None) -> Tensor:
        """(B, C, side, side) each -> the same shape."""
        fused = self.first(torch.cat([map_features, beside], dim=1))
        if vehicle_grid is not None:
            fused = fused + vehicle_grid.mean(dim=(2, 3), keepdim=True)
        return self.second(fused)


class Decoder(nn.Module):
    """U-Net decoder: doubles the resolution, with the aerial encoder's features beside, up to that of the image."""

    def __init__(self, settings: BackboneSettings, channels: int, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        skips = (settings.widths[1], settings.widths[0], settings.stem_width)
        inputs = (channels, *widths[:2])
        self.up = nn.ModuleList([convolution(a + b, c) for a, b, c in zip(inputs, skips, widths[:3], strict=True)])
        self.last = convolution(widths[2], widths[3])
        self.stem_stride = settings.stem_stride

    def forward(self, fused: Tensor, levels: list[Tensor]) -> Tensor:
        """(B, C, side, side) and the aerial levels -> (B, widths[3], H, W)."""
        x = fused
        for up, skip in zip(self.up, (levels[2], levels[1], levels[0]), strict=True):
            x = nn.functional.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=False)
            x = up(torch.cat([x, skip], dim=1))
        if self.stem_stride > 1:
            x = nn.functional.interpolate(x, scale_factor=self.stem_stride, mode="bilinear", align_corners=False)
        return self.last(x)


class PoseHeads(nn.Module):
    """Location and orientation, both linear in a cell's features: 1 x 1 convolutions, applied to lists of cells."""

    def __init__(self, channels: int, yaw_bins: int) -> None:
        super().__init__()
        self.location = nn.Linear(channels, 1, bias=False)  # the softmax over cells would not see a bias
        self.orientation = nn.Linear(channels, yaw_bins)


class ConfidenceHead(nn.Module):
    """Logit of the chance that the best pose is right, from features that it does not shape: they come detached."""

    def __init__(self, inputs: int, hidden: int = 16) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, 1))

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs) -> (B,)."""
        return self.mlp(features.detach()).squeeze(-1)


class RegressionHead(nn.Module):
    """The paper's ablation of the decoder: a pose straight from the pooled features.

    Gives east and north offset from the middle of the map in units, and cosine and sine of the heading relative to
    the prior's (not normalised).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(channels, channels), nn.ReLU(inplace=True), nn.Linear(channels, 4))

    def forward(self, pooled: Tensor) -> Tensor:
        """(B, C) -> (B, 4)."""
        return self.mlp(pooled)
