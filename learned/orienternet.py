"""OrienterNet with a LiDAR scan in place of its camera image (Sarlin et al., CVPR 2023), written from the paper.

From the paper: a neural map, that is a feature vector and a unary log-prior of every cell of the map (section 3.3); a
neural bird's-eye view of the scene with a feature vector and a confidence of every cell (3.2); exhaustive matching of
the confidence-weighted view, rotated to every heading, against the map, plus the prior (equation 1), averaged over
the view's cells; one joint softmax over position and heading (equation 2); the negative log-likelihood of the true
pose as the only loss.

Ours: the bird's-eye view is made of LiDAR returns, so the lifting of image columns to depth planes falls away, and it
reaches all around, not ahead only; the map is the picture of `learned.map_raster`, not embedded OpenStreetMap
classes; both encoders are small (`learned.feature_net`) instead of ResNet-101 and VGG-19; a learned scale stands
before the softmax, whose heading sum is the quadrature of `learned.losses`. At the paper's sizes (map 256 x 256,
template 129 x 129, 64 rotations) voting alone costs about 5.6 CPU-seconds a sample, so the default is features on
every fourth pixel, 2 m apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from fusion.errors import SkyfixError
from learned.bev import BANDS_M, BevSettings
from learned.calibration import Calibration
from learned.feature_net import Pyramid
from learned.losses import HeadingQuadrature
from learned.network import Architecture
from learned.voting_net import VotingFeatures, VotingMatcher, VotingNet, check_images

STRIDES = (2, 4, 8)


@dataclass(frozen=True, slots=True)
class OrienterNetSettings:
    """Sizes.

    Attributes
    ----------
    channels
        Features a cell (8 in the paper).
    stride
        Pixels a feature cell: 2, 4 or 8. The paper's is 1, which two CPU cores cannot train.
    map_widths, scan_widths
        Channels of the encoders' levels (strides 2, 4, 8, 16).
    bev
        The scan's image.
    quadrature
        Headings at which the training's likelihood is evaluated (64 evenly spaced ones in the paper).
    """

    channels: int = 8
    stride: int = 4
    map_widths: tuple[int, int, int, int] = (16, 32, 64, 96)
    scan_widths: tuple[int, int, int, int] = (16, 32, 64, 96)
    bev: BevSettings = field(default_factory=BevSettings)
    quadrature: HeadingQuadrature = field(default_factory=HeadingQuadrature)


class OrienterNet(VotingNet):
    """Neural map, neural bird's-eye view and their exhaustive matching."""

    def __init__(self, settings: OrienterNetSettings) -> None:
        if settings.stride not in STRIDES:
            raise SkyfixError(f"orienternet stride: expected one of {STRIDES}, got {settings.stride}")
        super().__init__(settings.bev, settings.stride, settings.quadrature)
        self.settings = settings
        level = STRIDES.index(settings.stride)
        self.map_encoder = Pyramid(3, settings.map_widths, level)
        self.scan_encoder = Pyramid(len(BANDS_M), settings.scan_widths, level)
        self.map_head = nn.Conv2d(settings.map_widths[level], settings.channels, 1)
        # A prior that is the same everywhere says nothing, so it has no bias.
        self.prior_head = nn.Conv2d(settings.map_widths[level], 1, 1, bias=False)
        self.scan_head = nn.Conv2d(settings.scan_widths[level], settings.channels + 1, 1)
        # Averages over thousands of cells hardly differ between poses; the scale starts near where sums would have it,
        # for features that are independent from cell to cell, and is learned.
        self.log_scale = nn.Parameter(torch.tensor(math.log(settings.bev.size / settings.stride / 4)))

    def neural_map(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Features (B, C, H / stride, W / stride) and unary log-prior (B, H / stride, W / stride) of pictures."""
        decoded = self.map_encoder.levels(picture)[0]
        return self.map_head(decoded), self.prior_head(decoded)[:, 0]

    def neural_bev(self, density: Tensor) -> tuple[Tensor, Tensor]:
        """Features (B, C, n / stride, n / stride) and confidence in [0, 1] (B, 1, ...) of scans."""
        raw = self.scan_head(self.scan_encoder.levels(density)[0])
        return raw[:, :-1], torch.sigmoid(raw[:, -1:])

    def features(self, density: Tensor, picture: Tensor) -> VotingFeatures:
        """The confidence-weighted view, scaled so that voting averages over its cells, the map and its prior."""
        check_images(density, picture, self.bev)
        neural_map, prior = self.neural_map(picture)
        view, confidence = self.neural_bev(density)
        cells = (self.bev.size // self.stride) ** 2
        return VotingFeatures(view * confidence * (self.log_scale.exp() / cells), neural_map, prior)

    def reaching(self, half_extent_m: float) -> OrienterNet:
        """The same weights for a scan image of another extent, with a cell's vote worth what it was."""
        net = OrienterNet(replace(self.settings, bev=replace(self.bev, half_extent_m=half_extent_m)))
        net.load_state_dict(self.state_dict())
        with torch.no_grad():
            net.log_scale.add_(2 * math.log(net.bev.size / self.bev.size))
        return net


class OrienterNetMatcher(VotingMatcher[OrienterNet]):
    """OrienterNet as a measurement model."""

    def __init__(self, net: OrienterNet, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        super().__init__("orienternet", net, calibration, yaw_bins)


ARCHITECTURE = Architecture("orienternet", OrienterNetSettings, OrienterNet, OrienterNetMatcher, OrienterNet.reaching)
