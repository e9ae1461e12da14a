"""What networks that vote have in common: their likelihood, their loss, and the matcher made of them.

Such a network turns a scan's bird's-eye view and a map's picture into two feature images on cells of the same size
(and, if it likes, a unary log-prior of every map cell); `learned.voting` makes scores for all poses of the two. The
features may depend on both inputs, but not on the heading, which is unknown until the vote.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.bev import BANDS_M, BevSettings, bev_counts, log_density
from learned.calibration import Calibration
from learned.losses import HeadingQuadrature, scores_nll
from learned.map_lattice import MapLattice, MapSearchSettings
from learned.map_raster import MapRaster
from learned.map_search import MapSearch
from learned.matcher import SearchRegion, matching_window
from learned.network import Batch, NetworkSettings, picture_tensor
from learned.voting import bin_yaws, prior_scores, volume_from_scores, vote, yaw_bins_within
from learned.whole_map import VotedMapSearch, WholeMapSearch

CROP_MULTIPLE = 16
"""Sides of map crops are multiples of this many pixels, the stride of the networks' coarsest level."""


class VotingFeatures(NamedTuple):
    """What voting needs of a batch, on cells of the network's stride.

    Attributes
    ----------
    scan
        (B, C, n, n), the body frame; a cell's vector is long where it is worth much.
    map
        (B, C, H, W).
    prior
        (B, H, W) log-prior of the vehicle standing in a cell, unnormalised, or None.
    """

    scan: Tensor
    map: Tensor
    prior: Tensor | None = None


class PoseScorer(Protocol):
    """A network that scores poses on a lattice of the map's cell corners; what `VotingMatcher` needs of it."""

    @property
    def settings(self) -> NetworkSettings:
        """What it was built from."""
        ...

    @property
    def stride(self) -> int:
        """Map pixels between the positions of the lattice."""
        ...

    def eval(self) -> object:
        """Go into evaluation mode."""
        ...

    def pose_scores(self, density: Tensor, picture: Tensor, yaws: Tensor) -> Tensor:
        """Unnormalised log densities (R, rows, cols) of headings (R,) for one scan (bands, n, n) and map (3, H, W).

        The lattice lies in the middle of the map: position (0, 0) is half the scan's image in from its corner.
        """
        ...


@runtime_checkable
class SeparateEncoders(Protocol):
    """A scorer whose map features do not depend on the scan, so that they can be kept."""

    def scan_features(self, density: Tensor) -> Tensor:
        """(B, bands, n, n) -> (B, C, n', n')."""
        ...

    def map_features(self, picture: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, C, H', W')."""
        ...


class VotingNet(nn.Module, ABC):
    """Base of networks that vote once: give it `features`, it gives the likelihood and the loss.

    Parameters
    ----------
    bev
        The scan's image.
    stride
        Pixels a feature cell; the scan's image has to be an even number of cells.
    quadrature
        Headings at which the likelihood is evaluated in training.
    """

    def __init__(self, bev: BevSettings, stride: int, quadrature: HeadingQuadrature) -> None:
        super().__init__()
        if bev.size % (2 * stride):
            raise SkyfixError(f"network: expected a scan image of a multiple of {2 * stride} pixels, got {bev.size}")
        self.bev, self.stride, self.quadrature = bev, stride, quadrature

    @abstractmethod
    def features(self, density: Tensor, picture: Tensor) -> VotingFeatures:
        """Features of scans (B, bands, n, n) and maps (B, 3, H, W)."""

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        """Mean negative log density of the true poses."""
        return {"total": self.truth_nll(batch, generator).mean()}

    def truth_nll(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """(B,) negative log density (per m^2 rad) of the true poses, all headings searched."""
        found = self.voted(self.features(batch.density, batch.picture), batch, generator)
        return torch.stack([vote.nll for vote in found])

    def voted(self, features: VotingFeatures, batch: Batch, generator: torch.Generator) -> list[Vote]:
        """Vote for every example of a batch at the quadrature's headings; in float32 under any autocast."""
        for _ in range(batch.first):
            self.quadrature.draw(0.0, generator)
        with torch.autocast(features.scan.device.type, enabled=False):
            return [self._vote(features, batch, index, generator) for index in range(len(batch))]

    def _vote(self, features: VotingFeatures, batch: Batch, index: int, generator: torch.Generator) -> Vote:
        truth = true_pose(batch, index, self.stride, self.bev.size)
        device = features.scan.device
        yaws, widths = (drawn.to(device) for drawn in self.quadrature.draw(truth[2], generator))
        scores = scores_of(features, index, yaws)
        nll = scores_nll(scores, truth, yaws, widths, self.bev.metres_per_pixel * self.stride, self.quadrature)
        return Vote(scores, yaws, widths, truth, nll)

    def pose_scores(self, density: Tensor, picture: Tensor, yaws: Tensor) -> Tensor:
        """See `PoseScorer.pose_scores`."""
        return scores_of(self.features(density[None], picture[None]), 0, yaws)


class Vote(NamedTuple):
    """One example's vote: scores (R, rows, cols) at headings `yaws` of widths `widths`, the truth and its loss.

    `truth` is row and column in the lattice of the scores, and yaw.
    """

    scores: Tensor
    yaws: Tensor
    widths: Tensor
    truth: tuple[float, float, float]
    nll: Tensor


def scores_of(features: VotingFeatures, index: int, yaws: Tensor) -> Tensor:
    """Votes (R, rows, cols) of one example of a batch at some headings, the prior added."""
    scan, found = features.scan[index].float(), features.map[index].float()
    scores = vote(found, scan, yaws)
    return scores if features.prior is None else scores + prior_scores(features.prior[index].float(), scan.shape[-1])


def true_pose(batch: Batch, index: int, stride: int, scan_size: int) -> tuple[float, float, float]:
    """Row and column in the lattice of the votes of a stride (integers are its positions), and yaw."""
    row, col = ((float(pixel[index]) - scan_size / 2) / stride for pixel in (batch.row, batch.col))
    return row, col, float(batch.yaw[index])


def check_images(density: Tensor, picture: Tensor, bev: BevSettings) -> None:
    """Raise SkyfixError unless scans are (B, bands, n, n) and finite and maps (B, 3, H, W), large enough and even.

    Sides of maps have to be multiples of `CROP_MULTIPLE`, so that all levels of a network stay in step.
    """
    size = bev.size
    if density.ndim != 4 or density.shape[1:] != (len(BANDS_M), size, size):
        raise SkyfixError(f"scan image: expected (B, {len(BANDS_M)}, {size}, {size}), got {tuple(density.shape)}")
    fits = picture.ndim == 4 and picture.shape[:2] == (len(density), 3)
    if not fits or any(side < size or side % CROP_MULTIPLE for side in picture.shape[2:]):
        expected = f"({len(density)}, 3, H, W), H and W multiples of {CROP_MULTIPLE} and at least {size}"
        raise SkyfixError(f"map image: expected {expected}, got {tuple(picture.shape)}")
    for name, image in (("scan image", density), ("map image", picture)):
        if not bool(torch.isfinite(image).all()):
            raise SkyfixError(f"{name}: expected finite values, got NaN or an infinity")


Net = TypeVar("Net", bound=PoseScorer)


class VotingMatcher(Generic[Net]):
    """A voting network as a measurement model; implements `learned.matcher.MapMatcher`.

    Parameters
    ----------
    name
        Short name for tables.
    net
        The network; it is put into evaluation mode.
    calibration
        Temperature and error correlation, from held-out data.
    yaw_bins
        Heading bins over the full circle (360: 1 degree each).
    """

    def __init__(self, name: str, net: Net, calibration: Calibration | None = None, yaw_bins: int = 360) -> None:
        net.eval()
        self._name, self.net = name, net
        self.calibration = calibration or Calibration()
        self.yaw_bins = yaw_bins
        self._over_map: tuple[MapRaster, WholeMapSearch] | None = None

    @property
    def name(self) -> str:
        """Short name for tables."""
        return self._name

    @property
    def error_correlation_length_m(self) -> float:
        """Distance over which errors decorrelate, metres."""
        return self.calibration.error_correlation_length_m

    def error_correlation_length_on(self, map_raster: MapRaster) -> float:
        """The same on one map; see `learned.matcher.MapDependentErrors`."""
        return self.calibration.correlation_length_on(map_raster)

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Likelihood of the poses in the search region; see `learned.matcher.MapMatcher.match`."""
        return self.match_counts(bev_counts(points, ground_z, self.net.settings.bev), map_raster, search)

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Match a bird's-eye view (bands, n, n) of point counts that has been made already."""
        density, picture, grid = self.images(counts, map_raster, search)
        bins = yaw_bins_within(float(search.centre[2]), search.half_heading_rad, self.yaw_bins)
        with torch.inference_mode():
            check_images(density[None], picture[None], self.net.settings.bev)
            scores = self.net.pose_scores(density, picture, bin_yaws(bins, self.yaw_bins))
        return volume_from_scores(scores / self.calibration.temperature, bins, self.yaw_bins, grid, self.net.stride)

    def over_map(self, map_raster: MapRaster) -> WholeMapSearch | None:
        """Prepare a whole map, see `learned.whole_map.WholeMapMatcher`; the last one is kept.

        A network whose features depend on scan and map together works on the whole map anew for every scan.
        """
        if self._over_map is None or self._over_map[0] is not map_raster:
            search = self._search_of(map_raster)
            if search is None:
                return None
            self._over_map = map_raster, search
        return self._over_map[1]

    def _search_of(self, map_raster: MapRaster) -> WholeMapSearch | None:
        net: object = self.net
        if not isinstance(net, SeparateEncoders | VotingNet):
            return None
        bev, stride = self.net.settings.bev, self.net.stride
        feature_m, settings = bev.metres_per_pixel * stride, MapSearchSettings()
        template, multiple = bev.size // stride, CROP_MULTIPLE // stride
        lattice = MapLattice.over(map_raster.grid, feature_m, template, self.yaw_bins, multiple, settings)
        rows, cols = lattice.window.rows * stride, lattice.window.cols * stride
        pixels = MapGrid(rows, cols, bev.metres_per_pixel, lattice.window.x0, lattice.window.y0)
        picture = picture_tensor(map_raster.resampled(pixels).picture)[None]

        def search(found: Tensor, prior: Tensor | None) -> MapSearch:
            return MapSearch(found, lattice, self.yaw_bins, self.calibration.temperature, settings, prior)

        if isinstance(net, SeparateEncoders):
            with torch.inference_mode():
                kept = search(net.map_features(picture)[0], None)
            return VotedMapSearch(bev, partial(_kept_features, net, kept))
        return VotedMapSearch(bev, partial(_joint_features, net, picture, search))

    def images(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> tuple[Tensor, Tensor, MapGrid]:
        """What the network is given: log densities (bands, n, n) and a picture (3, m, m); and the picture's grid."""
        bev = self.net.settings.bev
        reach = bev.size / 2 * bev.metres_per_pixel
        window = matching_window(map_raster, search, reach, bev.metres_per_pixel, multiple_of=CROP_MULTIPLE)
        crop = map_raster.resampled(window)
        return torch.from_numpy(log_density(counts)).float(), picture_tensor(crop.picture), crop.grid


def _density(counts: NDArray[np.float32]) -> Tensor:
    """Log densities (1, bands, n, n)."""
    return torch.from_numpy(log_density(counts)).float()[None]


def _kept_features(net: SeparateEncoders, kept: MapSearch, counts: NDArray[np.float32]) -> tuple[Tensor, MapSearch]:
    """A scan's features, and the map's as they were."""
    with torch.inference_mode():
        return net.scan_features(_density(counts))[0], kept


def _joint_features(
    net: VotingNet,
    picture: Tensor,
    search: Callable[[Tensor, Tensor | None], MapSearch],
    counts: NDArray[np.float32],
) -> tuple[Tensor, MapSearch]:
    """A scan's features and the map's, made together."""
    with torch.inference_mode():
        scan, found, prior = net.features(_density(counts), picture)
        return scan[0], search(found[0], None if prior is None else prior[0])
