"""What TransLocNet answers: maps over position and heading, or, in the ablation, a pose.

Cells are counted row by row and headings in bins relative to the prior's bin. Positions are in cells, (row, col),
integers at edges; the functions take and give truths in the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from learned.decoder import PoseHeads


@dataclass(frozen=True, slots=True)
class PoseMaps:
    """Location of every cell, and what the headings are computed from where they are asked for.

    Attributes
    ----------
    features
        (B, H, W, C) the decoder's output, float32.
    log_location
        (B, H, W) log probability of the cells.
    heads
        Linear maps from a cell's features to its location logit and heading logits.
    """

    features: Tensor
    log_location: Tensor
    heads: PoseHeads

    @classmethod
    def of(cls, features: Tensor, heads: PoseHeads) -> Self:
        """Apply the location head to features (B, C, H, W)."""
        by_cell = features.permute(0, 2, 3, 1)
        logits = heads.location(by_cell).squeeze(3).float()
        return cls(by_cell, logits.flatten(1).log_softmax(dim=1).view_as(logits), heads)

    @staticmethod
    def evidence_size(channels: int) -> int:
        """Length of a row of `evidence`."""
        return channels + 2

    def features_at(self, cells: Tensor) -> Tensor:
        """(B, N, C) features of cells (B, N)."""
        return self.features.flatten(1, 2).gather(1, cells[:, :, None].expand(-1, -1, self.features.shape[3]))

    def log_orientation(self, cells: Tensor) -> Tensor:
        """(B, N, K) log probability of the heading bins at cells (B, N)."""
        return self.heads.orientation(self.features_at(cells)).log_softmax(dim=-1)

    def best_cell(self) -> Tensor:
        """(B,) the likeliest cell."""
        return self.log_location.flatten(1).argmax(dim=1)

    def evidence(self) -> Tensor:
        """(B, C + 2): the features of the best cell, its log probability and the entropy of the location."""
        with torch.no_grad():
            log_p = self.log_location.flatten(1)
            peak, cell = log_p.max(dim=1)
            entropy = -(log_p.exp() * log_p).sum(dim=1)
            scale = math.log(log_p.shape[1])
            there = self.features_at(cell[:, None]).squeeze(1)
            return torch.cat([there, peak[:, None] / scale, entropy[:, None] / scale], dim=1)

    def soft_argmax(self) -> Tensor:
        """(B, 2) mean row and column of the location, differentiable."""
        p = self.log_location.exp()
        rows, cols = (torch.arange(n, device=p.device) + 0.5 for n in p.shape[1:])
        return torch.stack([(p.sum(dim=2) * rows).sum(dim=1), (p.sum(dim=1) * cols).sum(dim=1)], dim=1)

    def best_pose(self) -> tuple[Tensor, Tensor]:
        """Row and column of the middle of the best cell (B, 2), and the best heading bin's centre there (B,)."""
        cell = self.best_cell()
        width = self.features.shape[2]
        middle = torch.stack([cell // width, cell % width], dim=1) + 0.5
        log_p = self.log_orientation(cell[:, None]).squeeze(1)
        return middle, log_p.argmax(dim=1) * (2 * math.pi / log_p.shape[1])


@dataclass(frozen=True, slots=True)
class DirectPose:
    """Raw poses (B, 4): east and north in units from the middle of the crop, cosine and sine of relative heading."""

    raw: Tensor

    def offset_m(self, unit_m: float) -> Tensor:
        """(B, 2) metres east and north of the middle of the crop."""
        return self.raw[:, :2].float() * unit_m

    def direction(self) -> Tensor:
        """(B, 2) cosine and sine of the heading relative to the prior's bin, as they come."""
        return self.raw[:, 2:].float()

    def heading(self) -> Tensor:
        """(B,) radians, relative to the prior's bin."""
        return torch.atan2(self.raw[:, 3].float(), self.raw[:, 2].float())


@dataclass(frozen=True, slots=True)
class TransLocNetOutput:
    """What the network says of a batch.

    Attributes
    ----------
    pose
        Distributions over cells and headings, or poses (the direct regression).
    pooled_map, pooled_scan
        (B, C) means of the features before any attention between them.
    confidence
        (B,) logits.
    """

    pose: PoseMaps | DirectPose
    pooled_map: Tensor
    pooled_scan: Tensor
    confidence: Tensor
