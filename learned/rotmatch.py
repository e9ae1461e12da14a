"""RotMatch: learned features of scan and map through rotated-template voting, the default network on a CPU.

Two small U-Nets, one for the bird's-eye view of the scan and one for the picture of the map, give unit feature
vectors a metre apart; the scan's also says how much each cell is worth. Voting turns them into a score for every
pose. The principle is that of Barsan et al. (CoRL 2018) and of OrienterNet (Sarlin et al., CVPR 2023); sizes are
chosen for two CPU cores.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from learned.bev import BANDS_M, BevSettings, bev_counts, log_density
from learned.feature_net import STEM_STRIDE, FeatureNet
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion, matching_window
from learned.voting import bin_yaws, volume_from_scores, vote, yaw_bins_within

ARCHITECTURE = "rotmatch-1"
STRIDE = STEM_STRIDE


@dataclass(frozen=True, slots=True)
class RotMatchSettings:
    """Sizes: features a cell, widths of the U-Nets' levels (strides 2, 4, 8, 16), extent of the scan's image."""

    channels: int = 8
    widths: tuple[int, int, int, int] = (16, 32, 48, 64)
    bev: BevSettings = field(default_factory=BevSettings)


class RotMatchNet(nn.Module):
    """The two encoders and the scale of the score."""

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


@dataclass(frozen=True, slots=True)
class Calibration:
    """What is fitted on held-out data after training.

    Attributes
    ----------
    temperature
        Divides the scores.
    error_correlation_length_m
        Distance over which the errors of neighbouring frames decorrelate (1/e).
    """

    temperature: float = 1.0
    error_correlation_length_m: float = 6.0


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
        return volume_from_scores(scores, bins, self.yaw_bins, crop.grid, STRIDE)

    @classmethod
    def shipped(cls) -> Self:
        """The weights that come with the package."""
        with resources.as_file(resources.files("learned") / "weights" / "rotmatch.safetensors") as path:
            return cls.load(path)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a checkpoint: weights in PATH (.safetensors), sizes and calibration in the .json beside it.

        Raises
        ------
        SkyfixError
            If a file is missing or unreadable, or was written for another architecture or other sizes.
        """
        sidecar = path.with_suffix(".json")
        for file in (path, sidecar):
            if not file.is_file():
                raise SkyfixError(f"checkpoint: expected {file.name} at {file.parent}, got no such file")
        try:
            facts = json.loads(sidecar.read_text())
            architecture = facts["architecture"]
            if architecture != ARCHITECTURE:
                raise SkyfixError(f"checkpoint {path.name}: expected architecture {ARCHITECTURE}, got {architecture}")
            sizes = facts["settings"]
            settings = RotMatchSettings(sizes["channels"], tuple(sizes["widths"]), BevSettings(**sizes["bev"]))
            calibration = Calibration(**facts["calibration"])
            net = RotMatchNet(settings)
            net.load_state_dict(load_file(path))
        except (json.JSONDecodeError, KeyError, TypeError, SafetensorError) as error:
            raise SkyfixError(f"checkpoint {path.name}: expected a readable checkpoint, got {error!r}") from error
        except RuntimeError as error:
            what = str(error).splitlines()[-1].strip()
            raise SkyfixError(f"checkpoint {path.name}: its weights do not fit its stated sizes: {what}") from error
        return cls(net, calibration)

    def save(self, path: Path, provenance: dict[str, object]) -> None:
        """Write PATH (.safetensors) and the .json beside it; `provenance`: data, seed and command."""
        facts = {
            "architecture": ARCHITECTURE,
            "settings": asdict(self.net.settings),
            "calibration": asdict(self.calibration),
            "parameters": sum(p.numel() for p in self.net.parameters()),
            **provenance,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file({name: tensor.contiguous() for name, tensor in self.net.state_dict().items()}, path)
        path.with_suffix(".json").write_text(json.dumps(facts, indent=2) + "\n")


def picture_tensor(picture: NDArray[np.uint8]) -> Tensor:
    """(rows, cols, 3) uint8 -> (3, rows, cols) float32 in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float() / 255.0
