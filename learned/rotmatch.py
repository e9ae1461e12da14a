"""RotMatch: learned features of scan and map through rotated-template voting, the default network on a CPU.

Two small U-Nets, one for the bird's-eye view of the scan and one for the picture of the map, give unit feature
vectors a metre apart; the scan's also says how much each cell is worth. Voting turns them into a score for every
pose. The principle is that of Barsan et al. (CoRL 2018) and of OrienterNet (Sarlin et al., CVPR 2023); sizes are
chosen for two CPU cores.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from learned.bev import BANDS_M, BevSettings
from learned.calibration import Calibration
from learned.checkpoint import load_network, save_network
from learned.feature_net import STEM_STRIDE, FeatureNet
from learned.losses import HeadingQuadrature
from learned.network import Architecture
from learned.voting_net import VotingFeatures, VotingMatcher, VotingNet, check_images

STRIDE = STEM_STRIDE


@dataclass(frozen=True, slots=True)
class RotMatchSettings:
    """Sizes: features a cell, widths of the U-Nets' levels (strides 2, 4, 8, 16), extent of the scan's image.

    `quadrature` says at which headings the training's likelihood is evaluated.
    """

    channels: int = 8
    widths: tuple[int, int, int, int] = (16, 32, 48, 64)
    bev: BevSettings = field(default_factory=BevSettings)
    quadrature: HeadingQuadrature = field(default_factory=HeadingQuadrature)


class RotMatchNet(VotingNet):
    """The two encoders and the scale of the score; implements `learned.network.LocalizationNet`."""

    def __init__(self, settings: RotMatchSettings) -> None:
        super().__init__(settings.bev, STRIDE, settings.quadrature)
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

    def features(self, density: Tensor, picture: Tensor) -> VotingFeatures:
        """Both feature images; no prior."""
        check_images(density, picture, self.bev)
        return VotingFeatures(self.scan_features(density), self.map_features(picture))


class RotMatch(VotingMatcher[RotMatchNet]):
    """RotMatch as a measurement model; see `learned.voting_net.VotingMatcher`."""

    def __init__(self, net: RotMatchNet, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        super().__init__("rotmatch", net, calibration, yaw_bins)

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
