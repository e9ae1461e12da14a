"""TransLocNet's encoders under a vote: how to pre-train them, and what they are worth by themselves.

TransLocNet (arXiv 2512.10419) has to find out from the pose alone that scan and map are to be compared cell by cell.
Voting compares them so by construction: here the two residual encoders give unit feature vectors for every cell, all
their levels projected and added up, and the vote of RotMatch does the rest. `skyfix train translocnet_compact.yaml
--initial translocnet-voting.safetensors` then starts from these encoders. A scan is given as TransLocNet sees it, one
channel with zeros around, but not turned, for the heading is the vote's to find.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from learned.backbone import BackboneSettings, ResidualEncoder
from learned.bev import BevSettings
from learned.calibration import Calibration
from learned.feature_net import LevelHead
from learned.losses import HeadingQuadrature
from learned.network import Architecture
from learned.scan_image import scan_image
from learned.translocnet_settings import COMPACT_BACKBONE
from learned.voting_net import VotingFeatures, VotingMatcher, VotingNet, check_images

_WORTH_BIAS = -3.0
"""A cell's worth starts at sigmoid(-3), as RotMatch's: thousands of cells vote."""


@dataclass(frozen=True, slots=True)
class EncoderVoteSettings:
    """Sizes; the defaults are those of TransLocNet compact.

    Attributes
    ----------
    channels
        Features a cell.
    crop_px, pool, backbone
        As in `learned.translocnet_settings.TransLocNetSettings`; scans larger than the crop are given whole.
    bev, quadrature
        The scan's image; the headings at which the training's likelihood is evaluated.
    """

    channels: int = 8
    crop_px: int = 256
    pool: int = 2
    backbone: BackboneSettings = COMPACT_BACKBONE
    bev: BevSettings = field(default_factory=BevSettings)
    quadrature: HeadingQuadrature = field(default_factory=HeadingQuadrature)


class EncoderVoteNet(VotingNet):
    """Two residual encoders and one vote; implements `learned.network.LocalizationNet`."""

    def __init__(self, settings: EncoderVoteSettings) -> None:
        super().__init__(settings.bev, settings.pool * settings.backbone.stem_stride, settings.quadrature)
        self.settings = settings
        backbone, channels = settings.backbone, settings.channels
        widths = (backbone.stem_width, *backbone.widths)
        self.map_encoder, self.scan_encoder = ResidualEncoder(3, backbone), ResidualEncoder(1, backbone)
        self.map_head = LevelHead(widths, channels, multi_scale=True)
        self.scan_head = LevelHead(widths, channels + 1, multi_scale=True)
        self.log_scale = nn.Parameter(torch.zeros(()))
        for parameter in self.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)

    def features(self, density: Tensor, picture: Tensor) -> VotingFeatures:
        """Both feature images; no prior."""
        check_images(density, picture, self.bev)
        return VotingFeatures(self.scan_features(density), self.map_features(picture))

    def scan_features(self, density: Tensor) -> Tensor:
        """(B, bands, n, n) log densities -> (B, C, n', n'): unit vectors times the worth of their cell."""
        size = max(self.settings.crop_px, self.bev.size)
        image = scan_image(density, torch.zeros(len(density), device=density.device), size)
        raw = self._encoded(image, self.scan_encoder, self.scan_head)
        margin, cells = (size - self.bev.size) // (2 * self.stride), self.bev.size // self.stride
        raw = raw[:, :, margin : margin + cells, margin : margin + cells]
        worth = torch.sigmoid(raw[:, -1:] + _WORTH_BIAS)
        return functional.normalize(raw[:, :-1], dim=1) * worth * self.log_scale.exp()

    def map_features(self, picture: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, C, H', W') unit vectors."""
        return functional.normalize(self._encoded(picture, self.map_encoder, self.map_head), dim=1)

    def _encoded(self, image: Tensor, encoder: ResidualEncoder, head: LevelHead) -> Tensor:
        """Float32 features on cells of the stride; the image is padded for the coarsest level, and cut again."""
        height, width = image.shape[-2:]
        coarsest = 16 * self.stride
        padded = functional.pad(image, (0, -width % coarsest, 0, -height % coarsest))
        pooled = functional.avg_pool2d(padded, self.settings.pool).contiguous(memory_format=torch.channels_last)
        return head(encoder(pooled)).float()[:, :, : height // self.stride, : width // self.stride]

    def reaching(self, half_extent_m: float) -> EncoderVoteNet:
        """The same weights for a scan image of another extent."""
        net = EncoderVoteNet(replace(self.settings, bev=replace(self.bev, half_extent_m=half_extent_m)))
        net.load_state_dict(self.state_dict())
        return net


class EncoderVoteMatcher(VotingMatcher[EncoderVoteNet]):
    """TransLocNet's encoders under a vote as a measurement model."""

    def __init__(self, net: EncoderVoteNet, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        super().__init__("translocnet-voting", net, calibration, yaw_bins)


ARCHITECTURE = Architecture(
    "translocnet-voting", EncoderVoteSettings, EncoderVoteNet, EncoderVoteMatcher, EncoderVoteNet.reaching
)
