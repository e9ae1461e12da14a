"""TransLocNet's ideas on top of voting: the hybrid, of which every part can be taken away.

The trunk is RotMatch's: two small U-Nets and one vote over all poses. What TransLocNet (arXiv 2512.10419) and
OrienterNet (Sarlin et al., CVPR 2023) add is added here part by part, each behind one switch of `HybridSettings`, and
such that a part whose weights are zero is a part that is not there. So an ablation compares like with like.

The heading is unknown when features are made, and voting works because features turn with the scan. Every part keeps
to that: attention reads sets of tokens without positions (`learned.set_attention` argues it), the Fourier branch
gives one vector for a scan, the same for all its headings, and the rest is convolution. Attention joins the two
U-Nets at their coarsest level (stride 16 pixels: a map crop of 256 pixels has 16 x 16 tokens), before decoding, so
that what was read is spread over the finer levels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from fusion.errors import SkyfixError
from learned.bev import BANDS_M, BevSettings
from learned.calibration import Calibration
from learned.contrastive import Projection, info_nce
from learned.feature_net import STEM_STRIDE, LevelHead, Pyramid
from learned.losses import HeadingQuadrature
from learned.network import Architecture, Batch
from learned.set_attention import BidirectionalSetAttention, RingSpectrum
from learned.voting_net import Vote, VotingFeatures, VotingMatcher, VotingNet, check_images

_WORTH_BIAS = -3.0
"""A cell's worth starts at sigmoid(-3), as RotMatch's: thousands of cells vote."""
_HEADING_ARM_M = 10.0
"""The regression loss takes a heading error for what it displaces this far away."""


@dataclass(frozen=True, slots=True)
class HybridSettings:
    """Sizes and switches.

    Attributes
    ----------
    channels, widths
        Features a cell; channels of the U-Nets' levels (strides 2, 4, 8, 16).
    cross_attention, attention_heads
        Map and scan read from each other at the coarsest level.
    multi_scale
        The features are made of all levels of the decoder, not of the finest alone.
    fourier
        The scan's coarsest features are shifted by what its spectrum says.
    scan_worth
        The scan says how much each of its cells is worth; otherwise all are worth the same.
    map_prior
        The map says how likely a vehicle stands in each of its cells.
    learned_temperature
        The scale of the scores is learned; otherwise it stays one.
    contrastive_weight, embedding
        Weight of the contrastive loss of scans and their maps, and the size of its vectors; 0 takes it away.
    regression_weight
        Weight of the Huber loss of the mean pose (soft-argmax), metres; 0 takes it away.
    likelihood_weight
        Weight of the negative log density of the true pose; 0 leaves the mean pose alone to learn from: direct
        regression, as near as a network comes to it whose answer is a vote.
    bev, quadrature
        The scan's image; the headings at which the training's likelihood is evaluated.
    """

    channels: int = 8
    widths: tuple[int, int, int, int] = (16, 32, 48, 64)
    cross_attention: bool = True
    attention_heads: int = 4
    multi_scale: bool = True
    fourier: bool = True
    scan_worth: bool = True
    map_prior: bool = True
    learned_temperature: bool = True
    contrastive_weight: float = 0.1
    embedding: int = 32
    regression_weight: float = 0.1
    likelihood_weight: float = 1.0
    bev: BevSettings = field(default_factory=BevSettings)
    quadrature: HeadingQuadrature = field(default_factory=HeadingQuadrature)

    def __post_init__(self) -> None:
        heads, width = self.attention_heads, self.widths[-1]
        if self.cross_attention and (heads < 1 or width % heads):
            raise SkyfixError(f"hybrid attention_heads: expected a divisor of {width}, got {heads}")
        for name in ("contrastive_weight", "regression_weight", "likelihood_weight"):
            weight = getattr(self, name)
            if not (math.isfinite(weight) and weight >= 0):
                raise SkyfixError(f"hybrid {name}: expected zero or more, got {weight}")
        if self.likelihood_weight == 0 and self.regression_weight == 0:
            raise SkyfixError("hybrid: expected a likelihood_weight or a regression_weight above zero, got neither")


class HybridNet(VotingNet):
    """Two U-Nets that may attend to each other, one vote; implements `learned.network.LocalizationNet`."""

    def __init__(self, settings: HybridSettings) -> None:
        super().__init__(settings.bev, STEM_STRIDE, settings.quadrature)
        self.settings = settings
        widths, coarsest = settings.widths, settings.widths[-1]
        self.scan_trunk, self.map_trunk = Pyramid(len(BANDS_M), widths), Pyramid(3, widths)
        self.scan_head = LevelHead(widths, settings.channels, settings.multi_scale)
        self.map_head = LevelHead(widths, settings.channels, settings.multi_scale)
        self.attention = (
            BidirectionalSetAttention(coarsest, coarsest, settings.attention_heads)
            if settings.cross_attention
            else None
        )
        self.spectrum = RingSpectrum(coarsest, coarsest) if settings.fourier else None
        self.worth_head = nn.Conv2d(widths[0], 1, 1) if settings.scan_worth else None
        # A prior that is the same everywhere says nothing, so it has no bias.
        self.prior_head = nn.Conv2d(widths[0], 1, 1, bias=False) if settings.map_prior else None
        self.log_scale = nn.Parameter(torch.zeros(())) if settings.learned_temperature else None
        contrastive = settings.contrastive_weight > 0
        self.scan_projection = Projection(coarsest, settings.embedding) if contrastive else None
        self.map_projection = Projection(coarsest, settings.embedding) if contrastive else None

    def features(self, density: Tensor, picture: Tensor) -> VotingFeatures:
        """Unit feature vectors, the scan's times the worth of their cell, and the map's prior."""
        check_images(density, picture, self.bev)
        return self._joined(self.scan_trunk.encode(density), self.map_trunk.encode(picture))

    def _joined(self, scan: list[Tensor], found: list[Tensor]) -> VotingFeatures:
        """Features of encoded scans and maps."""
        if self.spectrum is not None:
            scan = [*scan[:-1], scan[-1] + self.spectrum(scan[-1])[:, :, None, None]]
        if self.attention is not None:
            coarsest = self.attention(scan[-1], found[-1])
            scan, found = [*scan[:-1], coarsest[0]], [*found[:-1], coarsest[1]]
        scan, found = self.scan_trunk.decode(scan), self.map_trunk.decode(found)
        votes = functional.normalize(self.scan_head(scan).float(), dim=1) * self._worth(scan[0])
        if self.log_scale is not None:
            votes = votes * self.log_scale.exp()
        prior = None if self.prior_head is None else self.prior_head(found[0])[:, 0].float()
        return VotingFeatures(votes, functional.normalize(self.map_head(found).float(), dim=1), prior)

    def _worth(self, finest: Tensor) -> Tensor:
        """How much each cell of the scan counts, (B, 1, n, n) or a constant."""
        if self.worth_head is None:
            return torch.sigmoid(torch.tensor(_WORTH_BIAS, device=finest.device))
        return torch.sigmoid(self.worth_head(finest).float() + _WORTH_BIAS)

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        """Negative log density of the true poses, the switched-on other losses, and their weighted sum."""
        check_images(batch.density, batch.picture, self.bev)
        scan, found = self.scan_trunk.encode(batch.density), self.map_trunk.encode(batch.picture)
        votes = self.voted(self._joined(scan, found), batch, generator)
        terms = {"nll": torch.stack([vote.nll for vote in votes]).mean()}
        total = self.settings.likelihood_weight * terms["nll"]
        if self.settings.regression_weight > 0:
            cell = self.bev.metres_per_pixel * self.stride
            terms["regression"] = torch.stack([regression_loss(vote, cell) for vote in votes]).mean()
            total = total + self.settings.regression_weight * terms["regression"]
        if self.scan_projection is not None and self.map_projection is not None:
            around = _mean_around_truth(found[-1], batch, self.bev.size / 2)
            pairs = self.scan_projection(scan[-1].float().mean(dim=(2, 3))), self.map_projection(around)
            terms["contrastive"] = info_nce(*pairs, positions_m=batch.place)
            total = total + self.settings.contrastive_weight * terms["contrastive"]
        return {"total": total, **terms}

    def reaching(self, half_extent_m: float) -> HybridNet:
        """The same weights for a scan image of another extent.

        Attention reads from any number of tokens, but was trained on the number that training's crops have.
        """
        net = HybridNet(replace(self.settings, bev=replace(self.bev, half_extent_m=half_extent_m)))
        net.load_state_dict(self.state_dict())
        return net


def _mean_around_truth(coarsest: Tensor, batch: Batch, reach_px: float) -> Tensor:
    """(B, C) mean of the map's features (B, C, h, w), from before attention, over what the scan could have seen.

    TransLocNet contrasts whole crops, most of which the scan has not seen.
    """
    height, width = coarsest.shape[-2:]
    pixels = batch.picture.shape[-2] / height
    row = (torch.arange(height) + 0.5)[None, :, None].to(batch.row) * pixels - batch.row[:, None, None]
    col = (torch.arange(width) + 0.5)[None, None, :].to(batch.col) * pixels - batch.col[:, None, None]
    near = ((row**2 + col**2) <= reach_px**2).to(coarsest.device, torch.float32)[:, None]
    return (coarsest.float() * near).sum(dim=(2, 3)) / near.sum(dim=(2, 3)).clamp(min=1.0)


def regression_loss(vote: Vote, metres_per_cell: float) -> Tensor:
    """Huber loss of the mean pose of a vote against the truth: x, y, and the heading on an arm of 10 m, metres.

    The mean is the density's (a soft-argmax), that of the heading circular.
    """
    row, col, yaw = vote.truth
    share = torch.softmax((vote.scores + torch.log(vote.widths)[:, None, None]).flatten(), dim=0).view_as(vote.scores)
    over_yaws, over_rows, over_cols = share.sum(dim=(1, 2)), share.sum(dim=(0, 2)), share.sum(dim=(0, 1))
    rows, cols = (torch.arange(len(weights)).to(weights) for weights in (over_rows, over_cols))
    away = vote.yaws - yaw
    heading = torch.atan2((over_yaws * torch.sin(away)).sum(), (over_yaws * torch.cos(away)).sum())
    along = ((over_rows * rows).sum() - row) * metres_per_cell
    across = ((over_cols * cols).sum() - col) * metres_per_cell
    errors = torch.stack([along, across, heading * _HEADING_ARM_M])
    return functional.huber_loss(errors, torch.zeros_like(errors), reduction="sum")


class HybridMatcher(VotingMatcher[HybridNet]):
    """The hybrid as a measurement model."""

    def __init__(self, net: HybridNet, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        super().__init__("hybrid", net, calibration, yaw_bins)


ARCHITECTURE = Architecture("hybrid", HybridSettings, HybridNet, HybridMatcher, HybridNet.reaching)
