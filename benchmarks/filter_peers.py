"""The same filter step by the tools that people put such filters together from: numpy, torch, and filterpy's parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from filterpy.monte_carlo import systematic_resample

from benchmarks.filter_model import (
    INCREMENT,
    NOISE_ROOT,
    OUTLIERS,
    SEED,
    Estimated,
    Lookup,
    mixture,
    moments,
    moved,
)
from fusion import LikelihoodVolume, se2
from fusion.arrays import FloatArray
from fusion.likelihood import log_uniform_density


@dataclass(slots=True, eq=False)
class NumpyFilter:
    """Whole arrays at a time: what a careful user of numpy writes."""

    particles: FloatArray
    lookup: Lookup
    rng: np.random.Generator

    @classmethod
    def start(cls, particles: FloatArray, lookup: Lookup) -> NumpyFilter:
        """On particles (N, 3)."""
        return cls(particles.copy(), lookup, np.random.default_rng(SEED))

    def step(self) -> Estimated:
        """Mean and covariance of the weighted cloud, then resampling."""
        self.particles = moved(self.particles, self.rng)
        weights = mixture(self.lookup, self.particles)
        weights /= weights.sum()
        estimated = moments(self.particles, weights)
        points = (np.arange(len(weights)) + self.rng.random()) / len(weights)
        chosen = np.searchsorted(np.cumsum(weights), points)
        self.particles = self.particles[np.minimum(chosen, len(weights) - 1)]
        return estimated


@dataclass(slots=True, eq=False)
class FilterpyFilter:
    """As filterpy's documentation and its author's book show it; filterpy has no maps, so scipy looks the volume up."""

    particles: FloatArray
    weights: FloatArray
    lookup: Lookup
    rng: np.random.Generator

    @classmethod
    def start(cls, particles: FloatArray, lookup: Lookup) -> FilterpyFilter:
        """On particles (N, 3)."""
        count = len(particles)
        return cls(particles.copy(), np.full(count, 1.0 / count), lookup, np.random.default_rng(SEED))

    def step(self) -> Estimated:
        """Predict, update, resample, estimate: the order of the book."""
        self.particles = moved(self.particles, self.rng)
        self.weights *= mixture(self.lookup, self.particles)
        self.weights += 1e-300
        self.weights /= self.weights.sum()
        indexes = systematic_resample(self.weights)
        self.particles[:] = self.particles[indexes]
        self.weights.fill(1.0 / len(self.weights))
        return moments(self.particles, self.weights)


@dataclass(slots=True, eq=False)
class TorchFilter:
    """On torch tensors in float32, the volume looked up by grid_sample."""

    particles: torch.Tensor
    volume: torch.Tensor
    centre: torch.Tensor
    half: torch.Tensor
    uniform: float
    floor: float
    generator: torch.Generator

    @classmethod
    def start(cls, particles: FloatArray, volume: LikelihoodVolume) -> TorchFilter:
        """On particles (N, 3); the headings are padded so that they wrap."""
        grid = volume.grid
        padded = np.concatenate([volume.log_prob, volume.log_prob[:, :, :1]], axis=2)
        half = [0.5 * (grid.cols - 1), -0.5 * (grid.rows - 1)]
        return cls(
            torch.from_numpy(particles.astype(np.float32)),
            torch.from_numpy(padded)[None, None],
            torch.tensor(grid.centre_xy.tolist()),
            torch.tensor(half) * grid.metres_per_pixel,
            float(np.exp(log_uniform_density(grid))),
            volume.floor,
            torch.Generator().manual_seed(SEED),
        )

    def step(self) -> Estimated:
        """Mean and covariance of the weighted cloud, then resampling."""
        p = self.particles
        root, delta = torch.from_numpy(NOISE_ROOT).float(), torch.tensor(INCREMENT.delta.tolist())
        forward, left, turn = (delta + torch.randn(p.shape, generator=self.generator) @ root.T).T
        cos, sin = torch.cos(p[:, 2]), torch.sin(p[:, 2])
        yaw = torch.remainder(p[:, 2] + turn + np.pi, se2.TWO_PI) - np.pi
        p = torch.stack([p[:, 0] + cos * forward - sin * left, p[:, 1] + sin * forward + cos * left, yaw], dim=1)

        place = (p[:, :2] - self.centre) / self.half
        heading = torch.remainder(yaw, se2.TWO_PI) * (2.0 / se2.TWO_PI) - 1.0
        grid = torch.stack([heading, place[:, 0], place[:, 1]], dim=1).view(1, -1, 1, 1, 3)
        value = torch.nn.functional.grid_sample(
            self.volume, grid, mode="bilinear", padding_mode="border", align_corners=True
        ).view(-1)
        side = 1.0 + 1.0 / torch.tensor([self.volume.shape[3] - 1.0, self.volume.shape[2] - 1.0])
        value = torch.where((place.abs() <= side).all(dim=1), value, torch.tensor(self.floor))
        weights = (1.0 - OUTLIERS) * torch.exp(value) + OUTLIERS * self.uniform
        weights = weights / weights.sum()

        mean = weights @ p
        mean[2] = torch.atan2(weights @ torch.sin(yaw), weights @ torch.cos(yaw))
        residual = p - mean
        residual[:, 2] = torch.remainder(residual[:, 2] + np.pi, se2.TWO_PI) - np.pi
        covariance = (weights[:, None] * residual).T @ residual
        points = (torch.arange(len(p)) + torch.rand(1, generator=self.generator)) / len(p)
        chosen = torch.searchsorted(torch.cumsum(weights.double(), 0), points.double())
        self.particles = p[chosen.clamp(max=len(p) - 1)]
        return mean.double().numpy(), covariance.double().numpy()
