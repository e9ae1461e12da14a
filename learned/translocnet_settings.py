"""Sizes and switches of TransLocNet: the paper's network, a small one for two CPU cores, and every ablation.

Ablations of the paper (arXiv 2512.10419) and the fields that make them: cross-attention -> concatenation
(`cross_attention`), multi-scale -> single scale (`multi_scale`), probabilistic decoder -> direct regression
(`probabilistic`), without Fourier features (`fourier`), without the regression loss (`loss.regression = 0`), without
the contrastive loss (`loss.contrastive = 0`). The sensitivity grid is over the last two, lambda 1 and lambda 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fusion.errors import SkyfixError
from learned.backbone import CHANNELS_PER_GROUP, BackboneSettings
from learned.bev import BevSettings
from learned.fourier import FourierMode

TOKEN_STRIDE = 8
"""Pixels of the stem's output that a token stands for, along a side."""


@dataclass(frozen=True, slots=True)
class LossSettings:
    """Weights and widths of the loss.

    Attributes
    ----------
    regression, contrastive
        lambda 1 and lambda 2; zero leaves the term out, and with it whatever only the term would train.
    confidence
        Weight of the confidence's cross-entropy; its features are detached, so it changes nothing else.
    location_sigma_m, heading_sigma_deg
        Widths of the targets.
    orientation_cells
        Cells in which the orientation is trained: those of the largest location target. 128 cells hold 99 % of the
        target's weight at 0.5 m a cell.
    position_unit_m, heading_unit_deg
        Errors are regressed in these units: the half ranges of the prior in the KITTI lists, so that both are about
        one at the start.
    huber_threshold
        In those units; below it the regression loss is quadratic.
    temperature, hard_negatives, same_place_m
        Of the contrastive loss, see `learned.contrastive.info_nce`.
    correct_m, correct_deg
        What counts as right when the confidence is trained.
    """

    regression: float = 2.0
    contrastive: float = 0.1
    confidence: float = 0.1
    location_sigma_m: float = 1.0
    heading_sigma_deg: float = 2.5
    orientation_cells: int = 128
    position_unit_m: float = 20.0
    heading_unit_deg: float = 10.0
    huber_threshold: float = 0.05
    temperature: float = 0.07
    hard_negatives: int = 16
    same_place_m: float = 20.0
    correct_m: float = 2.0
    correct_deg: float = 5.0

    def __post_init__(self) -> None:
        if min(self.regression, self.contrastive, self.confidence) < 0:
            raise SkyfixError(
                f"loss weights: expected none below 0, got {self.regression}, {self.contrastive} and {self.confidence}"
            )
        positive = (
            self.location_sigma_m, self.heading_sigma_deg, self.orientation_cells, self.position_unit_m,
            self.heading_unit_deg, self.huber_threshold, self.temperature, self.hard_negatives,
        )  # fmt: skip
        if min(positive) <= 0:
            raise SkyfixError(f"loss: expected widths, units and counts above 0, got {min(positive)}")


@dataclass(frozen=True, slots=True)
class TransLocNetSettings:
    """The network; the defaults are the paper's, for 256 x 256 pixels of 0.5 m.

    Attributes
    ----------
    bev
        Extent and resolution of the scans that it is given; they are padded with zeros, or cut, to the size of the
        crop. The paper's reach as far as the crop does (64 m); these defaults are the reach of the training data.
    crop_px
        Side of the map crop, pixels of the bird's-eye view's size.
    pool
        Pixels a side that are averaged into one before anything else.
    backbone
        Sizes of both encoders.
    channels, heads
        Of the tokens.
    decoder_widths
        Channels at 2, 4, 8 and 8 (or 16) times the resolution of the tokens.
    yaw_bins
        K, over the full circle.
    embedding
        Length of the contrastive embeddings.
    cross_attention, multi_scale, probabilistic, fourier
        The ablations. "rotation_pooled" is the Fourier branch that is invariant to rotation too.
    uniform_floor
        Weight of the uniform density mixed into the joint density: away from the truth orientation is not trained.
    regression_sigma_m, regression_sigma_deg
        Width of the Gaussian that stands for a directly regressed pose; not used by the probabilistic decoder.
    """

    bev: BevSettings = field(default_factory=BevSettings)
    crop_px: int = 256
    pool: int = 1
    backbone: BackboneSettings = field(default_factory=BackboneSettings)
    channels: int = 128
    heads: int = 4
    decoder_widths: tuple[int, int, int, int] = (64, 64, 64, 32)
    yaw_bins: int = 360
    embedding: int = 64
    cross_attention: bool = True
    multi_scale: bool = True
    probabilistic: bool = True
    fourier: FourierMode = "spectrum"
    uniform_floor: float = 0.02
    regression_sigma_m: float = 3.0
    regression_sigma_deg: float = 5.0
    loss: LossSettings = field(default_factory=LossSettings)

    def __post_init__(self) -> None:
        multiple = self.pool * self.backbone.stem_stride * 2 * TOKEN_STRIDE
        if self.crop_px < multiple or self.crop_px % multiple:
            raise SkyfixError(f"translocnet: expected a crop of a multiple of {multiple} pixels, got {self.crop_px}")
        for width in (self.channels, *self.decoder_widths):
            if width < CHANNELS_PER_GROUP or width % CHANNELS_PER_GROUP:
                raise SkyfixError(f"translocnet width: expected a multiple of {CHANNELS_PER_GROUP}, got {width}")
        if self.channels % self.heads:
            raise SkyfixError(f"translocnet: expected channels a multiple of heads, got {self.channels}, {self.heads}")
        if not 0.0 <= self.uniform_floor < 1.0:
            raise SkyfixError(f"translocnet: expected a uniform floor in [0, 1), got {self.uniform_floor}")
        if not self.probabilistic and self.loss.regression == 0:
            raise SkyfixError("translocnet: expected a regression loss or a probabilistic decoder, got neither")

    @property
    def half_crop_m(self) -> float:
        """Half the side of the map crop, metres."""
        return 0.5 * self.crop_px * self.bev.metres_per_pixel

    @property
    def cells(self) -> int:
        """Cells along a side of the location map."""
        return self.crop_px // self.pool

    @property
    def cell_m(self) -> float:
        """Side of such a cell, metres."""
        return self.bev.metres_per_pixel * self.pool

    @property
    def side(self) -> int:
        """Tokens along a side."""
        return self.cells // (self.backbone.stem_stride * TOKEN_STRIDE)


COMPACT_BACKBONE = BackboneSettings(16, 5, 1, (24, 48, 96, 160), (1, 1, 2, 1))


@dataclass(frozen=True, slots=True)
class CompactSettings(TransLocNetSettings):
    """TransLocNet for two CPU cores: 16 x 16 tokens of 8 m as in the full one, a twentieth of its weights.

    Pictures of 256 x 256 pixels of 0.5 m come in, as for every network here, and are averaged to 128 x 128 of 1 m:
    location is asked for to about a metre, walls survive the averaging as grey, and the first convolutions, which
    cost most, have a quarter of the pixels.
    """

    pool: int = 2
    backbone: BackboneSettings = COMPACT_BACKBONE
    channels: int = 64
    decoder_widths: tuple[int, int, int, int] = (48, 32, 32, 16)
