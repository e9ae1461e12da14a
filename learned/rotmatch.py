"""RotMatch: learned features of scan and map through rotated-template voting, the default network on a CPU.

Two small U-Nets, one for the bird's-eye view of the scan and one for the picture of the map, give unit feature
vectors a metre apart; the scan's also says how much each cell is worth. Voting turns them into a score for every
pose. The principle is that of Barsan et al. (CoRL 2018) and of OrienterNet (Sarlin et al., CVPR 2023); sizes are
chosen for two CPU cores.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fusion.likelihood import LikelihoodVolume
from learned.bev import BANDS_M, BevSettings, bev_counts, log_density
from learned.calibration import Calibration, with_heading_concentration
from learned.checkpoint import load_network, save_network
from learned.losses import HeadingQuadrature, truth_nll
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion, matching_window
from learned.network import Architecture, Batch, picture_tensor
from learned.voting import bin_yaws, volume_from_scores, vote, yaw_bins_within

STRIDE = 2


@dataclass(frozen=True, slots=True)
class RotMatchSettings:
    """Sizes: features a cell, widths of the U-Nets' levels (strides 2, 4, 8, 16), extent of the scan's image.

    `quadrature` says at which headings the training's likelihood is evaluated.
    """

    channels: int = 8
    widths: tuple[int, int, int, int] = (16, 32, 48, 64)
    bev: BevSettings = field(default_factory=BevSettings)
    quadrature: HeadingQuadrature = field(default_factory=HeadingQuadrature)


class _Block(nn.Sequential):
    """Convolution, group normalisation, ReLU. Even kernels keep a stride of 2 centred, so turning commutes with it."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=(kernel - stride + 1) // 2, bias=False),
            nn.GroupNorm(4, outputs),
            nn.ReLU(inplace=True),
        )


class FeatureNet(nn.Module):
    """A small U-Net: (B, inputs, H, W) -> (B, outputs, H / 2, W / 2), receptive field about the whole image."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        self.stem = nn.Sequential(_Block(inputs, widths[0], kernel=6, stride=STRIDE), _Block(widths[0], widths[0]))
        pairs = list(pairwise(widths))
        self.down = nn.ModuleList([nn.Sequential(_Block(a, b, kernel=4, stride=2), _Block(b, b)) for a, b in pairs])
        self.lateral = nn.ModuleList([nn.Conv2d(b, a, 1) for a, b in pairs])
        self.up = nn.ModuleList([_Block(a, a) for a, _ in pairs])
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Features at half the resolution of the image."""
        levels = [self.stem(image)]
        for down in self.down:
            levels.append(down(levels[-1]))
        x = levels.pop()
        for lateral, up in zip(reversed(self.lateral), reversed(self.up), strict=True):
            skip = levels.pop()
            coarse = nn.functional.interpolate(lateral(x), size=skip.shape[-2:], mode="bilinear", align_corners=False)
            x = up(skip + coarse)
        return self.head(x)


class RotMatchNet(nn.Module):
    """The two encoders and the scale of the score; implements `learned.network.LocalizationNet`."""

    def __init__(self, settings: RotMatchSettings) -> None:
        super().__init__()
        self.settings = settings
        self.scan_encoder = FeatureNet(len(BANDS_M), settings.channels + 1, settings.widths)
        self.map_encoder = FeatureNet(3, settings.channels, settings.widths)
        self.log_scale = nn.Parameter(torch.zeros(()))

    def reaching(self, half_extent_m: float) -> RotMatchNet:
        """The same weights for a scan image of another extent; the encoders are convolutional, so any will do.

        Training on a short reach is cheap; matching with a long one sees the next crossing.
        """
        bev = replace(self.settings.bev, half_extent_m=half_extent_m)
        net = RotMatchNet(replace(self.settings, bev=bev))
        net.load_state_dict(self.state_dict())
        return net

    def scan_features(self, density: Tensor) -> Tensor:
        """(B, bands, n, n) log densities -> (B, C, n / 2, n / 2): unit vectors times the worth of their cell."""
        raw = self.scan_encoder(density)
        worth = torch.sigmoid(raw[:, -1:] - 3.0)
        return nn.functional.normalize(raw[:, :-1], dim=1) * worth * self.log_scale.exp()

    def map_features(self, picture: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, C, H / 2, W / 2) unit vectors."""
        return nn.functional.normalize(self.map_encoder(picture), dim=1)

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        """Mean negative log density of the true poses."""
        return {"total": self.truth_nll(batch, generator).mean()}

    def truth_nll(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """(B,) negative log density (per m^2 rad) of the true poses, all headings searched."""
        scans, maps = self.scan_features(batch.density), self.map_features(batch.picture)
        truths = torch.stack([batch.row / STRIDE, batch.col / STRIDE, batch.yaw], dim=1).tolist()
        cell, quadrature = self.settings.bev.metres_per_pixel * STRIDE, self.settings.quadrature
        for _ in range(batch.first):
            quadrature.draw(0.0, generator)
        with torch.autocast(scans.device.type, enabled=False):
            losses = [
                truth_nll(m, s, (row, col, yaw), cell, quadrature, generator)
                for m, s, (row, col, yaw) in zip(maps.float(), scans.float(), truths, strict=True)
            ]
        return torch.stack(losses)


class RotMatch:
    """RotMatch as a measurement model; implements `learned.matcher.MapMatcher`.

    Parameters
    ----------
    net
        The encoders.
    calibration
        Temperature and error correlation, from held-out data.
    yaw_bins
        Heading bins over the full circle (360: 1 degree each).
    """

    def __init__(self, net: RotMatchNet, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        self.net = net.eval()
        self.calibration = calibration or Calibration()
        self.yaw_bins = yaw_bins

    @property
    def name(self) -> str:
        """Short name for tables."""
        return "rotmatch"

    @property
    def error_correlation_length_m(self) -> float:
        """Distance over which errors decorrelate, metres."""
        return self.calibration.error_correlation_length_m

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Likelihood of the poses in the search region; see `learned.matcher.MapMatcher.match`."""
        return self.match_counts(bev_counts(points, ground_z, self.net.settings.bev), map_raster, search)

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Match a bird's-eye view (bands, n, n) that has been made already."""
        bev = self.net.settings.bev
        reach = bev.size / 2 * bev.metres_per_pixel
        crop = map_raster.resampled(matching_window(map_raster, search, reach, bev.metres_per_pixel, multiple_of=16))
        bins = yaw_bins_within(float(search.centre[2]), search.half_heading_rad, self.yaw_bins)
        density = torch.from_numpy(log_density(counts))
        picture = picture_tensor(crop.picture)
        with torch.inference_mode():
            scan = self.net.scan_features(density[None])[0]
            features = self.net.map_features(picture[None])[0]
            scores = vote(features, scan, bin_yaws(bins, self.yaw_bins)) / self.calibration.temperature
        volume = volume_from_scores(scores, bins, self.yaw_bins, crop.grid, STRIDE)
        return with_heading_concentration(volume, self.calibration.heading_concentration)

    @classmethod
    def shipped(cls) -> Self:
        """The weights that come with the package."""
        with resources.as_file(resources.files("learned") / "weights" / "rotmatch.safetensors") as path:
            return cls.load(path)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a checkpoint of this architecture; see `learned.checkpoint.load_network`."""
        net, calibration = load_network(path, ARCHITECTURE)
        return cls(net, calibration)

    def save(self, path: Path, provenance: dict[str, object]) -> None:
        """Write PATH (.safetensors) and the .json beside it; see `learned.checkpoint.save_network`."""
        save_network(path, ARCHITECTURE, self.net, self.calibration, provenance)


ARCHITECTURE = Architecture("rotmatch", RotMatchSettings, RotMatchNet, RotMatch, RotMatchNet.reaching)
