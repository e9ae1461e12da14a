"""TransLocNet as a measurement model: counts and a map in, likelihoods over poses out.

Away from the truth the orientation head is not trained, so the joint density gets a uniform floor, whose weight is
the network's `uniform_floor`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fusion.errors import SkyfixError
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.location_orientation import LocationOrientationMaps
from learned.bev import bev_counts, log_density
from learned.calibration import Calibration
from learned.lazy_maps import LazyPoseMaps, search_window
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion, matching_window
from learned.network import Architecture, picture_tensor
from learned.scan_image import heading_bin
from learned.translocnet import TransLocNet
from learned.translocnet_output import DirectPose, PoseMaps, TransLocNetOutput
from learned.translocnet_settings import CompactSettings, TransLocNetSettings
from learned.voting import yaw_bins_within


class TransLocNetMatcher:
    """Implements `learned.network.NetworkMatcher` and `learned.matcher.BoundedMatcher`.

    Parameters
    ----------
    net
        The network.
    calibration
        Temperature, heading concentration and error correlation, from held-out data.
    """

    def __init__(self, net: TransLocNet, calibration: Calibration | None = None) -> None:
        self.net = net.eval()
        self.calibration = calibration or Calibration()

    @property
    def name(self) -> str:
        """Short name for tables."""
        return "translocnet"

    @property
    def error_correlation_length_m(self) -> float:
        """Distance over which errors decorrelate, metres."""
        return self.calibration.error_correlation_length_m

    def error_correlation_length_on(self, map_raster: MapRaster) -> float:
        """The same on one map; see `learned.matcher.MapDependentErrors`."""
        return self.calibration.correlation_length_on(map_raster)

    @property
    def largest_half_extent_m(self) -> float:
        """Half the side of the crop that the network sees, metres; see `learned.matcher.BoundedMatcher`."""
        return self.net.settings.half_crop_m

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Likelihood of the poses in the search region; see `learned.matcher.MapMatcher.match`."""
        return self.match_counts(bev_counts(points, ground_z, self.net.settings.bev), map_raster, search)

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Match a bird's-eye view (bands, n, n) that has been made already.

        Raises
        ------
        SkyfixError
            If the search reaches beyond the crop that the network sees.
        """
        settings = self.net.settings
        output, grid = self._run(counts, map_raster, search)
        bins = yaw_bins_within(float(search.centre[2]), search.half_heading_rad, settings.yaw_bins)
        if isinstance(output.pose, DirectPose):
            volume = self._gaussian_volume(output.pose, grid, search, bins)
        else:
            maps = self._lazy_maps(output, output.pose, grid, search).within(search)
            volume = maps.to_volume(bins, settings.uniform_floor)
        return self.calibration.applied(volume)

    def likelihood(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LazyPoseMaps:
        """Location over the whole crop, and the orientation where it is asked for; headings of the whole circle.

        It is calibrated; a filter mixes the floor in by `with_outliers`.

        Raises
        ------
        SkyfixError
            As `match`, and if the network regresses poses directly: then it has no maps.
        """
        output, grid = self._run(bev_counts(points, ground_z, self.net.settings.bev), map_raster, search)
        if isinstance(output.pose, DirectPose):
            raise SkyfixError("pose maps: expected a network with a probabilistic decoder, got direct regression")
        maps = self._lazy_maps(output, output.pose, grid, search).tempered(self.calibration.temperature)
        return maps.with_heading_concentration(self.calibration.heading_concentration)

    def maps(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LocationOrientationMaps:
        """Location and orientation, written out for the cells of the search region alone."""
        return self.likelihood(points, ground_z, map_raster, search).within(search).to_maps()

    def _run(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> tuple[TransLocNetOutput, MapGrid]:
        """The network's answer, and the grid of its cells."""
        settings = self.net.settings
        mpp, half = settings.bev.metres_per_pixel, self.largest_half_extent_m
        if search.half_extent_m > half:
            raise SkyfixError(f"search: expected a half extent of at most {half:g} m, got {search.half_extent_m:g}")
        # The window's side is rounded up to a multiple of the crop's: ask for a little less than one.
        reach = half - search.half_extent_m - 0.25 * mpp
        window = matching_window(map_raster, search, reach, mpp, multiple_of=settings.crop_px)
        crop = map_raster.resampled(window)
        density = torch.from_numpy(log_density(counts))[None]
        with torch.inference_mode():
            output = self.net(density, picture_tensor(crop.picture)[None], _prior_yaw(search))
        return output, MapGrid(settings.cells, settings.cells, settings.cell_m, window.x0, window.y0)

    def _lazy_maps(
        self, output: TransLocNetOutput, pose: PoseMaps, grid: MapGrid, search: SearchRegion
    ) -> LazyPoseMaps:
        with torch.inference_mode():
            location = pose.log_location[0] - 2 * math.log(grid.metres_per_pixel)
            confidence = float(torch.sigmoid(output.confidence[0]))
            first = int(heading_bin(_prior_yaw(search), self.net.settings.yaw_bins))
            head = pose.heads.orientation
            # Bin 0 of the head is the prior's: renumbered, bin 0 is east.
            weight, bias = (torch.roll(parameter, first, dims=0).numpy() for parameter in (head.weight, head.bias))
            features = pose.features[0].contiguous().numpy()
        return LazyPoseMaps(location.numpy(), features, weight, bias, grid, confidence)

    def _gaussian_volume(
        self, pose: DirectPose, grid: MapGrid, search: SearchRegion, bins: list[int]
    ) -> LikelihoodVolume:
        """A Gaussian about the regressed pose, on the cells of the search region."""
        settings = self.net.settings
        step = 2 * math.pi / settings.yaw_bins
        east, north = pose.offset_m(settings.loss.position_unit_m)[0].tolist()
        yaw = float(pose.heading()[0]) + int(heading_bin(_prior_yaw(search), settings.yaw_bins)) * step
        mean = np.array([*(grid.centre_xy + [east, north]), yaw])
        sigma = np.array([settings.regression_sigma_m] * 2 + [math.radians(settings.regression_sigma_deg)])
        region = search_window(grid, search)
        x, y = region.centres()
        mesh = np.stack(np.meshgrid(y, x, np.array(bins) * step, indexing="ij"), axis=-1).reshape(-1, 3)
        gaussian = GaussianLikelihood(mean, np.diag(sigma**2), region)
        values = gaussian.with_outliers(settings.uniform_floor).log_density(mesh[:, [1, 0, 2]])
        scores = np.zeros((region.rows, region.cols, settings.yaw_bins), dtype=np.float32)
        scores[:, :, bins] = values.reshape(region.rows, region.cols, len(bins))
        valid = np.zeros(settings.yaw_bins, dtype=np.bool_)
        valid[bins] = True
        return LikelihoodVolume.from_scores(scores, region, valid=valid)


def _prior_yaw(search: SearchRegion) -> Tensor:
    return torch.tensor([float(search.centre[2])], dtype=torch.float64)


ARCHITECTURE = Architecture(
    "translocnet",
    TransLocNetSettings,
    TransLocNet,
    TransLocNetMatcher,
    factored=True,
    needs_heading=True,
    pretrained_by={"translocnet-voting": ("map_encoder", "scan_encoder")},
)
COMPACT_ARCHITECTURE = replace(ARCHITECTURE, name="translocnet-compact", settings_type=CompactSettings)
