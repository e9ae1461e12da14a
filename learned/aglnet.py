"""AGL-Net's design with voting on two CPU cores (Guan et al., IROS 2024, arXiv 2404.03187), written from the paper.

From the paper: one architecture for scan and map; matching in two stages, the first with features taken directly
from the sensor data, the second with skeleton features; between them an alignment of the scales of scan and map, so
that a map of unknown scale will do; a scale loss and a skeleton loss beside the likelihood of the true pose in both
stages. Matching is exhaustive over rotated templates, as OrienterNet's.

Interpreted, because the paper leaves it open or because two cores ask for it:

- The bird's-eye view of `learned.bev` takes the place of the learned voxel encoder, the picture of
  `learned.map_raster` that of the satellite image.
- Scales are a few classes. The logit of a class is what the first stage's vote comes to with the scan brought to that
  scale (the log of the mean over poses, plus a bias a class), so the classifier has hardly a parameter of its own.
  Training enlarges maps by a class drawn at random; the first stage is trained at the true class, and matching takes
  the likeliest one. ``scales: [1.0]`` turns all of this off, which is right for maps of known scale.
- The first stage votes on coarse cells over the whole crop; the second on fine ones, in windows about the first's
  modes (see `learned.two_stage`, which also says how the two make one density).
- A skeleton is one channel that gates the fine features of both sides; its loss is that of `learned.skeleton`.

The likelihood that `truth_nll` reports chooses its windows among the quadrature's headings, which are dense about
the truth; a false heading that lies between two of the others is missed, so it is a little flattering.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from fusion.errors import SkyfixError
from learned.bev import BANDS_M, BevSettings
from learned.calibration import Calibration
from learned.correlation import correlate
from learned.feature_net import Pyramid
from learned.losses import HeadingQuadrature, scores_nll
from learned.network import Architecture, Batch
from learned.skeleton import skeleton_loss, skeleton_targets
from learned.two_stage import RefinementSettings, Window, headings_within, refined, window_about
from learned.voting import rotate_templates, vote
from learned.voting_net import VotingMatcher, check_images, true_pose
from learned.warps import scaled_maps, scaled_scans, seen_from

FINE_STRIDE = 2
_SCALE_HEADINGS = 24


@dataclass(frozen=True, slots=True)
class AglNetSettings:
    """Sizes and weights.

    Attributes
    ----------
    coarse_channels, fine_channels
        Features a cell in the two stages.
    coarse_level
        Level of the encoders that the first stage votes on: 1 is stride 4, 2 is stride 8.
    widths
        Channels of the encoders' levels (strides 2, 4, 8, 16).
    scales
        Classes of how much larger the map is than its stated resolution says.
    scale_weight, skeleton_weight
        Of the auxiliary losses.
    refinement
        Where the second stage looks.
    bev, quadrature
        The scan's image; the headings at which the training's likelihood is evaluated.
    """

    coarse_channels: int = 16
    fine_channels: int = 8
    coarse_level: int = 2
    widths: tuple[int, int, int, int] = (16, 32, 48, 64)
    scales: tuple[float, ...] = (0.8, 1.0, 1.25)
    scale_weight: float = 0.1
    skeleton_weight: float = 0.5
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    bev: BevSettings = field(default_factory=BevSettings)
    quadrature: HeadingQuadrature = field(default_factory=HeadingQuadrature)

    def __post_init__(self) -> None:
        if self.coarse_level not in (1, 2):
            raise SkyfixError(f"aglnet coarse_level: expected 1 or 2, got {self.coarse_level}")
        if not self.scales or min(self.scales) <= 0:
            raise SkyfixError(f"aglnet scales: expected positive numbers, got {self.scales}")


class StageFeatures(NamedTuple):
    """Of a batch of scans or maps: coarse (B, C, ...), fine (B, C', ...) and the skeleton's logits (B, ...)."""

    coarse: Tensor
    fine: Tensor
    skeleton: Tensor


class _Encoder(nn.Module):
    """One side: a pyramid, a head for each stage; the coarse one says what a cell is worth, too."""

    def __init__(self, inputs: int, settings: AglNetSettings) -> None:
        super().__init__()
        widths, self.level = settings.widths, settings.coarse_level
        self.pyramid = Pyramid(inputs, widths)
        self.coarse_head = nn.Conv2d(widths[self.level], settings.coarse_channels + 1, 1)
        self.fine_head = nn.Conv2d(widths[0], settings.fine_channels + 1, 1)

    def forward(self, image: Tensor) -> StageFeatures:
        """Unit vectors times the worth of their cell (coarse) and times the skeleton (fine)."""
        levels = self.pyramid.levels(image)
        coarse, fine = self.coarse_head(levels[self.level]).float(), self.fine_head(levels[0]).float()
        worth, skeleton = torch.sigmoid(coarse[:, -1:] - 1.0), fine[:, -1] - 2.0
        return StageFeatures(
            functional.normalize(coarse[:, :-1], dim=1) * worth,
            functional.normalize(fine[:, :-1], dim=1) * torch.sigmoid(skeleton)[:, None],
            skeleton,
        )


class AglNet(nn.Module):
    """Two encoders, two stages, one likelihood; implements `learned.network.LocalizationNet`."""

    def __init__(self, settings: AglNetSettings) -> None:
        super().__init__()
        self.settings, self.stride = settings, FINE_STRIDE
        self.coarse_stride = 2 ** (settings.coarse_level + 1)
        if settings.bev.size % (2 * self.coarse_stride):
            expected = f"a scan image of a multiple of {2 * self.coarse_stride} pixels"
            raise SkyfixError(f"aglnet: expected {expected}, got {settings.bev.size}")
        self.scan_encoder = _Encoder(len(BANDS_M), settings)
        self.map_encoder = _Encoder(3, settings)
        self.log_scale = nn.Parameter(torch.zeros(2))  # of the scores of the two stages
        # With one class there is nothing to tell apart, and nothing to learn.
        self.scale_bias = nn.Parameter(torch.zeros(len(settings.scales))) if len(settings.scales) > 1 else None

    def features(self, density: Tensor, picture: Tensor) -> tuple[StageFeatures, StageFeatures]:
        """Features of scans (B, bands, n, n), which carry the scales of the scores, and of maps (B, 3, H, W)."""
        check_images(density, picture, self.settings.bev)
        scan, found = self.scan_encoder(density), self.map_encoder(picture)
        coarse, fine = self.log_scale.exp()
        return StageFeatures(scan.coarse * coarse, scan.fine * fine, scan.skeleton), found

    def scale_logits(self, scan: Tensor, found: Tensor, yaws: Tensor) -> Tensor:
        """(S,) of coarse features (C, n, n) and (C, H, W): how well the scan fits somewhere, brought to each scale."""
        scales = torch.tensor(self.settings.scales, device=scan.device)
        candidates = scaled_scans(scan.expand(len(scales), -1, -1, -1), scales)
        scores = torch.stack([vote(found, candidate, yaws).flatten() for candidate in candidates])
        logits = torch.logsumexp(scores, dim=1) - math.log(scores.shape[1])
        return logits if self.scale_bias is None else logits + self.scale_bias

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        """Likelihood of the true poses in both stages, skeleton and scale losses, and their weighted sum."""
        settings, drawn = self.settings, _generators(batch, generator)
        classes = torch.stack([torch.randint(len(settings.scales), (), generator=own) for own in drawn])
        scales = torch.tensor(settings.scales)[classes].to(batch.picture)
        picture = batch.picture
        if self.scale_bias is not None:
            picture = scaled_maps(picture, batch.row, batch.col, scales)
        scan, found = self.features(batch.density, picture)
        with torch.autocast(scan.fine.device.type, enabled=False):
            aligned = scan._replace(coarse=scaled_scans(scan.coarse, scales), fine=scaled_scans(scan.fine, scales))
            stages = [
                (self._coarse_nll(batch, i, aligned, found, own), self._fine_nll(batch, i, aligned, found, own))
                for i, own in enumerate(drawn)
            ]
            coarse, fine = (torch.stack(nlls).mean() for nlls in zip(*stages, strict=True))
            skeleton = self._skeleton_loss(batch, scan.skeleton, found.skeleton, scales)
            total = coarse + fine + settings.skeleton_weight * skeleton
            terms = {"coarse": coarse, "fine": fine, "skeleton": skeleton}
            if self.scale_bias is not None:
                logits = [
                    self.scale_logits(scan.coarse[i], found.coarse[i], _spread_headings(own).to(coarse))
                    for i, own in enumerate(drawn)
                ]
                terms["scale"] = functional.cross_entropy(torch.stack(logits), classes.to(coarse.device))
                total = total + settings.scale_weight * terms["scale"]
        return {"total": total, **terms}

    def _coarse_nll(
        self, batch: Batch, index: int, scan: StageFeatures, found: StageFeatures, generator: torch.Generator
    ) -> Tensor:
        """The first stage: the truth among all poses of the crop, on coarse cells."""
        settings = self.settings
        truth = true_pose(batch, index, self.coarse_stride, settings.bev.size)
        yaws, widths = (drawn.to(scan.coarse.device) for drawn in settings.quadrature.draw(truth[2], generator))
        scores = vote(found.coarse[index], scan.coarse[index], yaws)
        cell = settings.bev.metres_per_pixel * self.coarse_stride
        return scores_nll(scores, truth, yaws, widths, cell, settings.quadrature)

    def _fine_nll(
        self, batch: Batch, index: int, scan: StageFeatures, found: StageFeatures, generator: torch.Generator
    ) -> Tensor:
        """The second stage: the truth among the poses of a window whose middle is off it by up to half its extent."""
        settings = self.settings
        row, col, yaw = true_pose(batch, index, self.stride, settings.bev.size)
        off = (torch.rand(2, generator=generator) - 0.5) * self._half_cells
        side = found.fine.shape[-1] - scan.fine.shape[-1] + 1
        height = found.fine.shape[-2] - scan.fine.shape[-2] + 1
        rows, cols = window_about(row + float(off[0]), col + float(off[1]), self._half_cells, (height, side))
        half_heading = math.radians(settings.refinement.half_heading_deg)
        drawn = headings_within(settings.quadrature, yaw, half_heading, generator)
        yaws, widths = (values.to(scan.fine.device) for values in drawn)
        scores = _window_scores(found.fine[index], scan.fine[index], yaws, rows, cols)
        truth = (row - rows.start, col - cols.start, yaw)
        cell = settings.bev.metres_per_pixel * self.stride
        return scores_nll(scores, truth, yaws, widths, cell, settings.quadrature)

    def _skeleton_loss(self, batch: Batch, scan: Tensor, found: Tensor, scales: Tensor) -> Tensor:
        """Both skeletons against the scan's returns, the map's seen from the true pose."""
        skeleton, observed = skeleton_targets(batch.density, self.stride)
        images = torch.stack([found, torch.ones_like(found)], dim=1)
        row, col = batch.row / self.stride, batch.col / self.stride
        seen = seen_from(images, row, col, batch.yaw, scales, scan.shape[-1])
        return skeleton_loss(scan, seen[:, 0], skeleton, observed & (seen[:, 1] > 0.5))

    @property
    def _half_cells(self) -> int:
        """Half a window's extent in fine cells."""
        spacing = self.settings.bev.metres_per_pixel * self.stride
        return max(round(self.settings.refinement.half_extent_m / spacing), 1)

    def _scores(
        self, scan: StageFeatures, found: StageFeatures, index: int, yaws: Tensor, log_widths: Tensor
    ) -> Tensor:
        """Scores (R, rows, cols) of both stages on the fine lattice, the scan at its likeliest scale."""
        few = yaws[:: math.ceil(len(yaws) / _SCALE_HEADINGS)]
        scale_class = int(self.scale_logits(scan.coarse[index], found.coarse[index], few).argmax())
        scale = torch.tensor([self.settings.scales[scale_class]], device=yaws.device)
        coarse_scan, fine_scan = (scaled_scans(side[index : index + 1], scale)[0] for side in scan[:2])
        coarse = vote(found.coarse[index], coarse_scan, yaws)
        lattice = [f - s + 1 for f, s in zip(found.fine.shape[-2:], fine_scan.shape[-2:], strict=True)]
        coarse = functional.interpolate(coarse[None], size=lattice, mode="bilinear", align_corners=True)[0]

        def fine_scores(window: Window) -> Tensor:
            return _window_scores(found.fine[index], fine_scan, yaws[window.headings], window.rows, window.cols)

        return refined(coarse, yaws, log_widths, self._half_cells, self.settings.refinement, fine_scores)

    def truth_nll(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """(B,) negative log density (per m^2 rad) of the true poses under both stages, all headings searched."""
        settings, nlls = self.settings, []
        scan, found = self.features(batch.density, batch.picture)
        with torch.autocast(scan.fine.device.type, enabled=False):
            for index, own in enumerate(_generators(batch, generator)):
                truth = true_pose(batch, index, self.stride, settings.bev.size)
                yaws, widths = (drawn.to(scan.fine.device) for drawn in settings.quadrature.draw(truth[2], own))
                scores = self._scores(scan, found, index, yaws, torch.log(widths))
                cell = settings.bev.metres_per_pixel * self.stride
                nlls.append(scores_nll(scores, truth, yaws, widths, cell, settings.quadrature))
        return torch.stack(nlls)

    def pose_scores(self, density: Tensor, picture: Tensor, yaws: Tensor) -> Tensor:
        """See `learned.voting_net.PoseScorer.pose_scores`."""
        scan, found = self.features(density[None], picture[None])
        return self._scores(scan, found, 0, yaws, torch.zeros_like(yaws))

    def reaching(self, half_extent_m: float) -> AglNet:
        """The same weights for a scan image of another extent."""
        bev = replace(self.settings.bev, half_extent_m=half_extent_m)
        net = AglNet(replace(self.settings, bev=bev))
        net.load_state_dict(self.state_dict())
        return net


def _generators(batch: Batch, generator: torch.Generator) -> list[torch.Generator]:
    """One generator an example, the same however a step's batch is shared out."""
    seeds = torch.randint(2**62, (batch.first + len(batch),), generator=generator)[batch.first :]
    return [torch.Generator().manual_seed(int(seed)) for seed in seeds]


def _spread_headings(generator: torch.Generator) -> Tensor:
    """Headings all around, with a random phase."""
    phase = torch.rand((), generator=generator)
    return (torch.arange(_SCALE_HEADINGS) + phase) * (2 * math.pi / _SCALE_HEADINGS)


def _window_scores(found: Tensor, scan: Tensor, yaws: Tensor, rows: slice, cols: slice) -> Tensor:
    """Votes (R, rows, cols) in a window of the lattice alone: only the map under it is correlated."""
    size = scan.shape[-1]
    patch = found[:, rows.start : rows.stop - 1 + size, cols.start : cols.stop - 1 + size]
    return correlate(patch, rotate_templates(scan, yaws))


class AglNetMatcher(VotingMatcher[AglNet]):
    """AGL-Net as a measurement model."""

    def __init__(self, net: AglNet, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        super().__init__("aglnet", net, calibration, yaw_bins)


ARCHITECTURE = Architecture("aglnet", AglNetSettings, AglNet, AglNetMatcher, AglNet.reaching)
