"""The loss of TransLocNet (arXiv 2512.10419), and the likelihood of the truth by which networks are compared.

    L = L_loc + L_ori + lambda_1 L_reg + lambda_2 L_contrastive + 0.1 L_confidence

- L_loc: cross-entropy of the cells with a Gaussian target. The paper's divergence of the prediction from the target
  is infinite wherever a narrow target is zero.
- L_ori: cross-entropy of the heading bins with a von Mises target, in each cell, weighted by the location target; of
  the cells those of the largest target, because all of them would be 94 MB a sample.
- L_reg: Huber's loss of the mean position and mean heading (soft-argmax: an argmax has no gradient). The heading's
  error is the chord between the mean direction and the true one: it is smooth where a flat distribution has no
  direction at all.
- L_contrastive: `learned.contrastive`, on features from before the attention.
- L_confidence: binary cross-entropy with whether the best pose is right.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from learned.contrastive import info_nce
from learned.network import Batch
from learned.scan_image import heading_bin
from learned.translocnet_output import DirectPose, PoseMaps, TransLocNetOutput
from learned.translocnet_settings import LossSettings, TransLocNetSettings

_TWO_PI = 2 * math.pi


def training_losses(
    settings: TransLocNetSettings,
    output: TransLocNetOutput,
    embeddings: tuple[Tensor, Tensor] | None,
    batch: Batch,
) -> dict[str, Tensor]:
    """Terms of the loss by name, unweighted, and their weighted sum as "total"; those that are off are absent.

    `embeddings` are those of scans and maps, or None without a contrastive loss.
    """
    weights, pose = settings.loss, output.pose
    cells, heading = truth_in_cells(settings, batch), relative_heading(settings, batch)
    terms: dict[str, Tensor] = {}
    if isinstance(pose, PoseMaps):
        target = location_target(cells, settings.cells, weights.location_sigma_m / settings.cell_m)
        terms["location"] = -(target * pose.log_location.flatten(1)).sum(dim=1).mean()
        share, log_p = _sparse_orientation(pose, target, weights.orientation_cells)
        bins = heading_target(heading, settings.yaw_bins, weights.heading_sigma_deg)
        terms["orientation"] = orientation_loss(log_p, share, bins)
        if weights.regression > 0:
            metres = (pose.soft_argmax() - cells) * settings.cell_m
            terms["regression"] = _regression(weights, metres, mean_direction(log_p, share), heading)
    else:
        metres = pose.offset_m(weights.position_unit_m) - _offset_m(settings, cells)
        terms["regression"] = _regression(weights, metres, pose.direction(), heading)
    if embeddings is not None:
        k, places = weights.hard_negatives, batch.place
        terms["contrastive"] = info_nce(*embeddings, weights.temperature, k, places, weights.same_place_m)
    right = is_right(settings, pose, cells, heading).to(output.confidence.dtype)
    terms["confidence"] = functional.binary_cross_entropy_with_logits(output.confidence, right)
    factors = {"regression": weights.regression, "contrastive": weights.contrastive, "confidence": weights.confidence}
    total = torch.stack([factors.get(name, 1.0) * term for name, term in terms.items()]).sum()
    return {"total": total, **terms}


def truth_in_cells(settings: TransLocNetSettings, batch: Batch) -> Tensor:
    """(B, 2) float32 true row and column in cells of the location map, integers at edges."""
    return (torch.stack([batch.row, batch.col], dim=1) / settings.pool).float()


def relative_heading(settings: TransLocNetSettings, batch: Batch) -> Tensor:
    """(B,) float32 true heading relative to the prior's bin, in [-pi, pi)."""
    prior = heading_bin(batch.prior_yaw, settings.yaw_bins) * (_TWO_PI / settings.yaw_bins)
    return wrapped(batch.yaw - prior).float()


def wrapped(angle: Tensor) -> Tensor:
    """The same direction in [-pi, pi)."""
    return torch.remainder(angle + math.pi, _TWO_PI) - math.pi


def location_target(truth: Tensor, cells: int, sigma_cells: float) -> Tensor:
    """(B, cells^2) Gaussian about truths (B, 2), at the middles of the cells, summing to one."""
    middle = torch.arange(cells, device=truth.device) + 0.5
    rows, cols = ((middle - truth[:, axis, None]) ** 2 for axis in (0, 1))
    squared = rows[:, :, None] + cols[:, None, :]
    return (-0.5 * squared / sigma_cells**2).flatten(1).softmax(dim=1)


def heading_target(heading: Tensor, bins: int, sigma_deg: float) -> Tensor:
    """(B, bins) von Mises density about headings (B,), summing to one."""
    centres = torch.arange(bins, device=heading.device) * (_TWO_PI / bins)
    return (torch.cos(centres - heading[:, None]) / math.radians(sigma_deg) ** 2).softmax(dim=1)


def _sparse_orientation(pose: PoseMaps, target: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Shares (B, N) of the N cells of the largest target, summing to one, and log p(heading) (B, N, K) there."""
    share, chosen = target.topk(min(count, target.shape[1]), dim=1)
    return share / share.sum(dim=1, keepdim=True), pose.log_orientation(chosen)


def orientation_loss(log_p: Tensor, share: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy of headings (B, N, K) with a target (B, K), cells weighted by their shares (B, N)."""
    per_cell = -(log_p * target[:, None, :]).sum(dim=2)
    return (share * per_cell).sum(dim=1).mean()


def mean_direction(log_p: Tensor, share: Tensor) -> Tensor:
    """(B, 2) mean cosine and sine of the heading over cells and bins; shorter than one where it is spread."""
    p = (share[:, :, None] * log_p.exp()).sum(dim=1)
    centres = torch.arange(p.shape[1], device=p.device) * (_TWO_PI / p.shape[1])
    return torch.stack([(p * torch.cos(centres)).sum(dim=1), (p * torch.sin(centres)).sum(dim=1)], dim=1)


def _regression(weights: LossSettings, metres: Tensor, direction: Tensor, heading: Tensor) -> Tensor:
    """Mean over the batch of Huber's losses of x, y and heading, their errors in units."""
    truth = torch.stack([torch.cos(heading), torch.sin(heading)], dim=1)
    chord = ((direction - truth) ** 2).sum(dim=1, keepdim=True).add(1e-8).sqrt()
    errors = torch.cat([metres / weights.position_unit_m, chord / math.radians(weights.heading_unit_deg)], dim=1)
    zero = torch.zeros_like(errors)
    return functional.smooth_l1_loss(errors, zero, beta=weights.huber_threshold, reduction="none").sum(dim=1).mean()


def _offset_m(settings: TransLocNetSettings, cells: Tensor) -> Tensor:
    """(B, 2) metres east and north of the crop's middle, of (row, col)."""
    from_middle = (cells - settings.cells / 2) * settings.cell_m
    return torch.stack([from_middle[:, 1], -from_middle[:, 0]], dim=1)


@torch.no_grad()
def is_right(settings: TransLocNetSettings, pose: PoseMaps | DirectPose, cells: Tensor, heading: Tensor) -> Tensor:
    """(B,) whether the best pose is within the settings' bounds of the truth."""
    if isinstance(pose, PoseMaps):
        best, best_heading = pose.best_pose()
        metres = (best - cells) * settings.cell_m
    else:
        metres = pose.offset_m(settings.loss.position_unit_m) - _offset_m(settings, cells)
        best_heading = pose.heading()
    near = torch.linalg.vector_norm(metres, dim=1) < settings.loss.correct_m
    return near & (wrapped(best_heading - heading).abs() < math.radians(settings.loss.correct_deg))


def true_pose_nll(settings: TransLocNetSettings, pose: PoseMaps | DirectPose, batch: Batch) -> Tensor:
    """(B,) negative log density, per m^2 rad, of the true poses, the uniform floor mixed in as for a filter."""
    cells, heading = truth_in_cells(settings, batch), relative_heading(settings, batch)
    uniform = -math.log((settings.cells * settings.cell_m) ** 2 * _TWO_PI)
    if isinstance(pose, DirectPose):
        return -_with_floor(_gaussian_log_density(settings, pose, cells, heading), settings.uniform_floor, uniform)
    corners, place_weights = _corners(cells, settings.cells)
    step = _TWO_PI / settings.yaw_bins
    position = torch.remainder(heading / step, settings.yaw_bins)
    below = position.floor()
    bins = torch.stack([below, below + 1], dim=1).long() % settings.yaw_bins
    bin_weights = torch.stack([1 - (position - below), position - below], dim=1)
    location = pose.log_location.flatten(1).gather(1, corners)
    orientation = pose.log_orientation(corners).gather(2, bins[:, None, :].expand(-1, corners.shape[1], -1))
    joint = location[:, :, None] + orientation - math.log(settings.cell_m**2 * step)
    weight = place_weights[:, :, None] * bin_weights[:, None, :]
    return -(weight * _with_floor(joint, settings.uniform_floor, uniform)).sum(dim=(1, 2))


def _with_floor(log_density: Tensor, share: float, log_uniform: float) -> Tensor:
    if share == 0.0:
        return log_density
    floor = torch.full_like(log_density, math.log(share) + log_uniform)
    return torch.logaddexp(log_density + math.log1p(-share), floor)


def _gaussian_log_density(settings: TransLocNetSettings, pose: DirectPose, cells: Tensor, heading: Tensor) -> Tensor:
    metres = pose.offset_m(settings.loss.position_unit_m) - _offset_m(settings, cells)
    turn = wrapped(pose.heading() - heading)
    sigma_m, sigma_rad = settings.regression_sigma_m, math.radians(settings.regression_sigma_deg)
    squared = (metres**2).sum(dim=1) / sigma_m**2 + turn**2 / sigma_rad**2
    return -0.5 * squared - math.log(sigma_m**2 * sigma_rad) - 1.5 * math.log(_TWO_PI)


def _corners(truth: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """Indices and bilinear weights (B, 4) of the cells whose middles surround (row, col); clamped to the map."""
    at = (truth - 0.5).clamp(0.0, cells - 1.0)
    low = at.floor().clamp(max=cells - 2)
    part = at - low
    indices, weights = [], []
    for down in (0, 1):
        for right in (0, 1):
            indices.append((low[:, 0] + down) * cells + low[:, 1] + right)
            weights.append((part[:, 0] if down else 1 - part[:, 0]) * (part[:, 1] if right else 1 - part[:, 1]))
    return torch.stack(indices, dim=1).long(), torch.stack(weights, dim=1)
