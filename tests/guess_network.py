"""The least network there can be: a Gaussian about the crop's centre and a bump about the heading known beforehand.

It looks at nothing and learns two widths, and it goes through every door that a real network goes through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fusion.likelihood import LikelihoodVolume
from learned.bev import BevSettings, bev_counts
from learned.calibration import Calibration
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from learned.network import Architecture, Batch

YAW_BINS = 72


@dataclass(frozen=True, slots=True)
class GuessSettings:
    """`poison_at`: from this log width on the loss is NaN. `dropout`: noise from torch's global generator."""

    bev: BevSettings = field(default_factory=BevSettings)
    poison_at: float = math.inf
    dropout: float = 0.0


class GuessNet(nn.Module):
    """Widths of position and heading; ln(heading concentration) too."""

    def __init__(self, settings: GuessSettings) -> None:
        super().__init__()
        self.settings = settings
        self.log_sigma = nn.Parameter(torch.randn(()))
        self.log_kappa = nn.Parameter(torch.zeros(()))
        self.register_buffer("seen", torch.zeros((), dtype=torch.int64))
        self.autocast: list[bool] = []

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        self.seen += len(batch)
        self.autocast.append(torch.is_autocast_enabled("cpu"))
        position, heading = self.terms(batch)
        total = (position + heading).mean() * (1 + self.settings.dropout * torch.rand(()))
        if float(self.log_sigma.detach()) >= self.settings.poison_at:
            total = total * float("nan")
        return {"total": total, "position": position.mean(), "heading": heading.mean()}

    def truth_nll(self, batch: Batch, generator: torch.Generator) -> Tensor:
        position, heading = self.terms(batch)
        return position + heading

    def terms(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Negative log densities (B,) of the true positions and headings."""
        half = batch.picture.shape[-1] / 2
        squared = ((batch.row - half) ** 2 + (batch.col - half) ** 2) * batch.metres_per_pixel**2
        position = squared / (2 * torch.exp(2 * self.log_sigma)) + 2 * self.log_sigma + math.log(2 * math.pi)
        kappa = self.log_kappa.exp()
        bump = torch.cos(batch.yaw - batch.prior_yaw)
        heading = torch.log(2 * math.pi * torch.special.i0e(kappa)) - kappa * (bump - 1)
        return position, heading


class GuessMatcher:
    """The Gaussian about the search's centre."""

    name = "guess"

    def __init__(self, net: GuessNet, calibration: Calibration) -> None:
        self.net, self.calibration = net.eval(), calibration

    @property
    def error_correlation_length_m(self) -> float:
        return self.calibration.error_correlation_length_m

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        return self.match_counts(bev_counts(points, ground_z, self.net.settings.bev), map_raster, search)

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        grid = map_raster.grid.window(search.centre[:2], search.half_extent_m)
        x, y = grid.centres()
        squared = (x[None, :] - search.centre[0]) ** 2 + (y[:, None] - search.centre[1]) ** 2
        yaw = np.arange(YAW_BINS) * 2 * np.pi / YAW_BINS
        sigma, kappa = math.exp(self.net.log_sigma.item()), math.exp(self.net.log_kappa.item())
        scores = -squared[:, :, None] / (2 * sigma**2) + kappa * np.cos(yaw - search.centre[2])
        return self.calibration.applied(LikelihoodVolume.from_scores(scores, grid))


GUESS = Architecture("guess", GuessSettings, GuessNet, GuessMatcher, factored=True)
