"""Samples of random wall blocks on a map and the returns that a vehicle among them would have: quick to make."""

from __future__ import annotations

import math

import numpy as np

from learned.map_raster import CLASS_INDEX
from learned.samples import Sample

WALL = CLASS_INDEX["wall"]


def landmark_sample(seed: int) -> Sample:
    """Random wall blocks on a map, and the body-height returns that a vehicle among them would have."""
    rng = np.random.default_rng(seed)
    row, col, yaw = 168 + rng.uniform(-4, 4), 168 + rng.uniform(-4, 4), rng.uniform(-math.pi, math.pi)
    classes = np.zeros((336, 336), np.uint8)
    counts = np.zeros((4, 160, 160), np.uint8)
    for _ in range(40):
        ahead, left = rng.uniform(-74, 74, 2)
        top = row - (math.sin(yaw) * ahead + math.cos(yaw) * left)
        side = col + (math.cos(yaw) * ahead - math.sin(yaw) * left)
        classes[round(top) - 2 : round(top) + 2, round(side) - 2 : round(side) + 2] = WALL
        counts[1, round(80 - left) - 2 : round(80 - left) + 2, round(80 + ahead) - 2 : round(80 + ahead) + 2] = 30
    return Sample(counts, classes, row, col, yaw)


class Landmarks:
    """A sample source of landmark samples."""

    def __init__(self, count: int) -> None:
        self.samples = [landmark_sample(seed) for seed in range(count)]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        return self.samples[index]

    def order(self, rng: np.random.Generator) -> np.ndarray:
        return rng.permutation(len(self))
