"""A tiny TransLocNet for tests, and scans and maps for it."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from learned.backbone import BackboneSettings
from learned.bev import BevSettings, log_density
from learned.network import Batch, picture_tensor
from learned.translocnet_settings import TransLocNetSettings

TINY = TransLocNetSettings(
    bev=BevSettings(12.0, 0.5),
    crop_px=64,
    backbone=BackboneSettings(8, 3, 1, (8, 16, 16, 24), (1, 1, 1, 1)),
    channels=16,
    decoder_widths=(16, 16, 16, 16),
    yaw_bins=72,
    embedding=8,
)
"""8 x 8 tokens over 32 m, some 40,000 weights."""


def noise_batch(count: int = 3, settings: TransLocNetSettings = TINY, seed: int = 0) -> Batch:
    """Noise for scans and maps, truths anywhere in the middle, priors within 10 degrees."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    row, col = (settings.crop_px * (0.3 + 0.4 * uniform(count)).double() for _ in range(2))
    yaw = (2 * uniform(count).double() - 1) * math.pi
    prior_yaw = yaw + math.radians(10) * (2 * uniform(count).double() - 1)
    size = settings.bev.size
    density, picture = uniform(count, 4, size, size), uniform(count, 3, settings.crop_px, settings.crop_px)
    return Batch(density, picture, row, col, yaw, prior_yaw)


def landmarks(yaw: float, seed: int, crop_px: int, scan_px: int) -> tuple[NDArray[np.float32], ...]:
    """Counts (4, n, n), a picture (m, m, 3) uint8 and the true (row, col) among random posts."""
    rng = np.random.default_rng(seed)
    row, col = crop_px / 2 + rng.uniform(-crop_px / 9, crop_px / 9, 2)
    picture = np.zeros((crop_px, crop_px, 3), np.uint8)
    counts = np.zeros((4, scan_px, scan_px), np.float32)
    for _ in range(14):
        ahead, left = rng.uniform(-scan_px / 2 + 2, scan_px / 2 - 2, 2)
        top = round(row - (math.sin(yaw) * ahead + math.cos(yaw) * left))
        side = round(col + (math.cos(yaw) * ahead - math.sin(yaw) * left))
        picture[max(top - 2, 0) : max(top + 2, 0), max(side - 2, 0) : max(side + 2, 0), 0] = 255
        middle = round(scan_px / 2 - left), round(scan_px / 2 + ahead)
        counts[1, middle[0] - 2 : middle[0] + 2, middle[1] - 2 : middle[1] + 2] = 15
    return counts, picture, np.array([row, col])


def landmark_batch(yaws: list[float], prior_errors: list[float], crop_px: int, scan_px: int) -> Batch:
    """One sample among landmarks for every heading (radians), each with a prior that is off by so much."""
    made = [landmarks(yaw, seed, crop_px, scan_px) for seed, yaw in enumerate(yaws)]
    density = torch.from_numpy(np.stack([log_density(counts) for counts, _, _ in made]))
    picture = torch.stack([picture_tensor(picture) for _, picture, _ in made])
    row, col = torch.from_numpy(np.stack([place for _, _, place in made])).T
    yaw = torch.tensor(yaws, dtype=torch.float64)
    return Batch(density, picture, row, col, yaw, yaw + torch.tensor(prior_errors, dtype=torch.float64))
