"""Calibration on held-out data: how far a matcher's likelihoods may be believed.

A network that was trained on other maps, or weights chosen by hand, give scores on a scale of their own. One
temperature, fitted by maximum likelihood of the true poses (Guo et al., "On Calibration of Modern Neural Networks",
ICML 2017, section 4.2), puts them right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from learned.samples import SAMPLE_METRES_PER_PIXEL, Sample

_LOG_TEMPERATURE_BOUNDS = (np.log(0.05), np.log(50.0))


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


class CountsMatcher(Protocol):
    """A matcher that takes a bird's-eye view that has been made already."""

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Likelihood of the poses in a search region."""
        ...


def sample_map(sample: Sample) -> MapRaster:
    """The map of a sample, in a frame whose origin is the lower left corner of its class raster."""
    rows, cols = sample.classes.shape
    return MapRaster.from_classes(MapGrid(rows, cols, SAMPLE_METRES_PER_PIXEL, 0.0, 0.0), sample.classes)


def match_samples(
    matcher: CountsMatcher, samples: Sequence[Sample], half_extent_m: float, half_heading_rad: float, seed: int
) -> tuple[list[LikelihoodVolume], NDArray[np.float64]]:
    """Match samples within boxes that lie about the truth at seeded uniform offsets.

    Returns
    -------
    The volumes, and the true poses (N, 3), each in the frame of its sample's class raster (origin at its lower left
    corner).
    """
    rng = np.random.default_rng(seed)
    half = np.array([half_extent_m, half_extent_m, half_heading_rad])
    volumes, truths = [], []
    for sample in samples:
        raster = sample_map(sample)
        truth = np.array([*raster.grid.xy_from_pixel((sample.row, sample.col)), sample.yaw])
        search = SearchRegion(truth + rng.uniform(-half, half), half_extent_m, half_heading_rad)
        volumes.append(matcher.match_counts(sample.counts.astype(np.float32), raster, search))
        truths.append(truth)
    return volumes, np.array(truths)


def mean_nll(
    volumes: Sequence[LikelihoodVolume], truths: NDArray[np.float64], temperature: float, outliers: float = 0.0
) -> float:
    """Mean negative log density, per m^2 rad, of the true poses (N, 3) under volumes at a temperature.

    `outliers` is the weight of the uniform density that a filter mixes in; with it a single wild frame does not
    decide the fit.
    """
    values = [
        volume.tempered(temperature).with_outliers(outliers).log_density(truth[None])[0]
        for volume, truth in zip(volumes, truths, strict=True)
    ]
    return -float(np.mean(values))


def fit_temperature(volumes: Sequence[LikelihoodVolume], truths: NDArray[np.float64], outliers: float = 0.05) -> float:
    """Temperature that makes the true poses most likely.

    Parameters
    ----------
    volumes
        Likelihoods of held-out frames.
    truths
        (N, 3) true poses, inside the volumes' crops.
    outliers
        Weight of the uniform density mixed in, as in the filter.

    Returns
    -------
    The temperature by which to divide the scores of the same matcher, relative to the one it has.

    Raises
    ------
    SkyfixError
        If there are no volumes or the numbers differ.
    """
    if len(volumes) == 0 or len(volumes) != len(truths):
        raise SkyfixError(f"calibration: expected as many volumes as truths, got {len(volumes)} and {len(truths)}")
    found = minimize_scalar(
        lambda log_t: mean_nll(volumes, truths, float(np.exp(log_t)), outliers),
        bounds=_LOG_TEMPERATURE_BOUNDS,
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(np.exp(found.x))
