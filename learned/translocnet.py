"""TransLocNet: a scan and a map through two encoders, cross-attention and a decoder (arXiv 2512.10419).

Where the paper leaves a choice: tokens are 16 x 16 (those of its encoder; 256 x 256 would need 17 GB a head); the
scan is turned to the prior heading first; only what the map reads from the scan (a2b) is on the map's grid and is
fused there; and headings are answered **relative to the heading bin nearest the prior**, because a turned scan no
longer says where north was. Bin k of K means prior bin + k; `learned.translocnet_likelihood` renumbers them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from fusion.errors import SkyfixError
from learned.attention import BidirectionalCrossAttention
from learned.backbone import ResidualEncoder
from learned.contrastive import Projection
from learned.decoder import ConfidenceHead, Decoder, Fusion, Neck, PoseHeads, RegressionHead
from learned.fourier import FourierBranch
from learned.network import Batch
from learned.scan_image import heading_bin, scan_image
from learned.translocnet_losses import training_losses, true_pose_nll
from learned.translocnet_output import DirectPose, PoseMaps, TransLocNetOutput
from learned.translocnet_settings import TransLocNetSettings


class TransLocNet(nn.Module):
    """The network; implements `learned.network.LocalizationNet`."""

    def __init__(self, settings: TransLocNetSettings) -> None:
        super().__init__()
        self.settings = settings
        channels, side = settings.channels, settings.side
        self.map_encoder = ResidualEncoder(3, settings.backbone)
        self.scan_encoder = ResidualEncoder(1, settings.backbone)
        self.map_neck = Neck(settings.backbone, channels, settings.multi_scale)
        self.scan_neck = Neck(settings.backbone, channels, settings.multi_scale)
        self.fourier: FourierBranch | None = None
        if settings.fourier != "off":
            self.fourier = FourierBranch(channels, side, settings.fourier == "rotation_pooled")
        self.attention: BidirectionalCrossAttention | None = None
        if settings.cross_attention:
            self.attention = BidirectionalCrossAttention(channels, settings.heads, side)
        self.fusion = Fusion(channels)
        self.decoder: Decoder | None = None
        self.heads: PoseHeads | None = None
        self.regression: RegressionHead | None = None
        if settings.probabilistic:
            self.decoder = Decoder(settings.backbone, channels, settings.decoder_widths)
            self.heads = PoseHeads(settings.decoder_widths[3], settings.yaw_bins)
        else:
            self.regression = RegressionHead(channels)
        evidence = PoseMaps.evidence_size(settings.decoder_widths[3]) if settings.probabilistic else 0
        self.confidence = ConfidenceHead(channels + evidence)
        self.map_projection: Projection | None = None
        self.scan_projection: Projection | None = None
        if settings.loss.contrastive > 0:
            self.map_projection = Projection(channels, settings.embedding)
            self.scan_projection = Projection(channels, settings.embedding)
        for parameter in self.parameters():
            if parameter.ndim == 4:  # a third quicker on a CPU
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)

    def forward(self, density: Tensor, picture: Tensor, prior_yaw: Tensor) -> TransLocNetOutput:
        """Compare scans with maps.

        Parameters
        ----------
        density
            (B, bands, n, n) log densities, body frame, of the map's resolution.
        picture
            (B, 3, crop_px, crop_px) in [0, 1].
        prior_yaw
            (B,) headings known beforehand, radians.

        Raises
        ------
        SkyfixError
            If a shape is wrong or a value is not finite.
        """
        levels, map_features = self._map_features(picture)
        scan_features = self._scan_features(density, prior_yaw)
        beside, vehicle_grid = scan_features, None
        if self.attention is not None:
            beside, vehicle_grid = self.attention(map_features, scan_features)
        fused = self.fusion(map_features, beside, vehicle_grid)
        pooled = fused.mean(dim=(2, 3))
        pose: PoseMaps | DirectPose
        if self.decoder is not None and self.heads is not None:
            pose = PoseMaps.of(self.decoder(fused, levels).float(), self.heads)
            confidence = self.confidence(torch.cat([pooled, pose.evidence()], dim=1))
        elif self.regression is not None:
            pose = DirectPose(self.regression(pooled))
            confidence = self.confidence(pooled)
        before_map, before_scan = (features.mean(dim=(2, 3)).float() for features in (map_features, scan_features))
        return TransLocNetOutput(pose, before_map, before_scan, confidence.float())

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        """Terms of the loss; nothing in them is random."""
        self._check_scale(batch)
        output = self(batch.density, batch.picture, batch.prior_yaw)
        with torch.autocast(batch.density.device.type, enabled=False):
            embeddings = None
            if self.scan_projection is not None and self.map_projection is not None:
                embeddings = self.scan_projection(output.pooled_scan), self.map_projection(output.pooled_map)
            return training_losses(self.settings, output, embeddings, batch)

    def truth_nll(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """(B,) negative log density, per m^2 rad, of the true poses; all of the crop and all headings are searched."""
        self._check_scale(batch)
        output = self(batch.density, batch.picture, batch.prior_yaw)
        with torch.autocast(batch.density.device.type, enabled=False):
            return true_pose_nll(self.settings, output.pose, batch)

    def scan_embedding(self, density: Tensor, prior_yaw: Tensor | None = None) -> Tensor:
        """Unit vectors (B, embedding) of scans, to be looked up among those of maps.

        `prior_yaw` (B,), zero when left out, is the heading that they are turned to, as in `forward`.
        """
        projection = self._projection(self.scan_projection)
        yaw = torch.zeros(len(density), device=density.device) if prior_yaw is None else prior_yaw
        return projection(self._scan_features(density, yaw).mean(dim=(2, 3)))

    def map_embedding(self, picture: Tensor) -> Tensor:
        """Unit vectors (B, embedding) of map crops (B, 3, crop_px, crop_px)."""
        return self._projection(self.map_projection)(self._map_features(picture)[1].mean(dim=(2, 3)))

    def _projection(self, projection: Projection | None) -> Projection:
        if projection is None:
            raise SkyfixError("embedding: expected a network with a contrastive loss, got contrastive weight 0")
        return projection

    def _map_features(self, picture: Tensor) -> tuple[list[Tensor], Tensor]:
        size = self.settings.crop_px
        if picture.ndim != 4 or picture.shape[1:] != (3, size, size):
            raise SkyfixError(f"map picture: expected (B, 3, {size}, {size}), got {tuple(picture.shape)}")
        if not torch.isfinite(picture).all():
            raise SkyfixError("map picture: expected finite values, got NaN or an infinity")
        levels = self.map_encoder(self._pooled(picture))
        return levels, self.map_neck(levels)

    def _scan_features(self, density: Tensor, prior_yaw: Tensor) -> Tensor:
        bins = self.settings.yaw_bins
        yaw = heading_bin(prior_yaw, bins) * (2 * math.pi / bins)
        image = scan_image(density, yaw, self.settings.crop_px)
        features = self.scan_neck(self.scan_encoder(self._pooled(image)))
        return features if self.fourier is None else self.fourier(features)

    def _pooled(self, image: Tensor) -> Tensor:
        """Average to the network's resolution."""
        pooled = image if self.settings.pool == 1 else nn.functional.avg_pool2d(image, self.settings.pool)
        return pooled.contiguous(memory_format=torch.channels_last)

    def _check_scale(self, batch: Batch) -> None:
        expected = self.settings.bev.metres_per_pixel
        if not math.isclose(batch.metres_per_pixel, expected, rel_tol=1e-6):
            raise SkyfixError(f"batch: expected {expected:g} m a pixel, got {batch.metres_per_pixel:g}")
