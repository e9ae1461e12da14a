"""Calibration on held-out data: how far a matcher's likelihoods may be believed.

A network that was trained on other maps, or weights chosen by hand, give scores on a scale of their own. One
temperature, fitted by maximum likelihood of the true poses (Guo et al., "On Calibration of Modern Neural Networks",
ICML 2017, section 4.2), puts them right. A network that predicts headings apart from positions may be as wrong about
its headings in another measure: they get a concentration of their own, fitted in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume, PoseLikelihood, log_uniform_density
from learned.confidence import fit_confidence, peak_mass, probability
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from learned.samples import SAMPLE_METRES_PER_PIXEL, Sample

RIGHT_WITHIN_M = 5.0
"""A single shot is right when its best mode is this near to the true position."""

_LOG_TEMPERATURE_BOUNDS = (np.log(0.05), np.log(50.0))
_LOG_CONCENTRATION_BOUNDS = (np.log(0.02), np.log(20.0))


@dataclass(frozen=True, slots=True)
class Calibration:
    """What is fitted on held-out data after training.

    Attributes
    ----------
    temperature
        Divides the scores.
    error_correlation_length_m
        Distance over which the errors of neighbouring frames decorrelate (1/e).
    heading_concentration
        The density of the heading at each position is raised to this power; see `with_heading_concentration`.
    confidence_slope, confidence_intercept
        From the mass in the best mode to the chance that it is right; see `learned.confidence`.
    bare_map_correlation_length_m
        As `error_correlation_length_m`, on maps that show no buildings. What is left to go by there, how far walls and
        fences stand from a carriageway, is guessed wrong for a whole street at a time.
    """

    temperature: float = 1.0
    error_correlation_length_m: float = 6.0
    heading_concentration: float = 1.0
    confidence_slope: float = 1.0
    confidence_intercept: float = 0.0
    bare_map_correlation_length_m: float = 25.0

    def __post_init__(self) -> None:
        for name in (
            "temperature",
            "error_correlation_length_m",
            "bare_map_correlation_length_m",
            "heading_concentration",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise SkyfixError(f"calibration {name}: expected above zero, got {value}")
        for name in ("confidence_slope", "confidence_intercept"):
            if not math.isfinite(getattr(self, name)):
                raise SkyfixError(f"calibration {name}: expected a number, got {getattr(self, name)}")

    def correlation_length_on(self, map_raster: MapRaster) -> float:
        """Distance over which errors decorrelate on this map, metres."""
        return self.error_correlation_length_m if map_raster.shows_buildings else self.bare_map_correlation_length_m

    def applied(self, volume: LikelihoodVolume) -> LikelihoodVolume:
        """A likelihood of the matcher before calibration -> one of the calibrated matcher."""
        return with_heading_concentration(volume.tempered(self.temperature), self.heading_concentration)

    def confidence(self, likelihood: PoseLikelihood) -> float:
        """The chance that the best mode of a calibrated likelihood is right: within `RIGHT_WITHIN_M` of the truth."""
        return self.chance(peak_mass(likelihood))

    def chance(self, mass: float) -> float:
        """The same from the mass of the best mode."""
        return float(probability(mass, self.confidence_slope, self.confidence_intercept)[0])


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
    _check_pairs(volumes, truths)
    found = minimize_scalar(
        lambda log_t: mean_nll(volumes, truths, float(np.exp(log_t)), outliers),
        bounds=_LOG_TEMPERATURE_BOUNDS,
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(np.exp(found.x))


def with_heading_concentration(volume: LikelihoodVolume, concentration: float) -> LikelihoodVolume:
    """Raise the density of the heading given the position to a power, normalised again at each position.

    The density of the position alone stays as it is. Above 1 headings get sharper.
    """
    if concentration == 1.0:
        return volume
    bins = np.flatnonzero(volume.bin_peaks > volume.floor)  # of many there are often few
    searched = volume.log_prob[:, :, bins]
    evaluated = searched > volume.floor
    width = np.log(se2.TWO_PI / volume.log_prob.shape[2])
    log_prob = np.where(evaluated, searched.astype(np.float64), -np.inf)
    position = logsumexp(log_prob, axis=2, keepdims=True) + width
    with np.errstate(invalid="ignore"):  # positions that were evaluated at no heading
        powered = concentration * (log_prob - position)
        powered += position - logsumexp(powered, axis=2, keepdims=True) - width
    floor = min(volume.floor, float(powered.min(where=evaluated, initial=np.inf)) - 1.0)
    result = np.full_like(volume.log_prob, floor)
    result[:, :, bins] = np.where(evaluated, powered, floor)
    return LikelihoodVolume(result, volume.grid, floor)


def fit_heading_concentration(
    volumes: Sequence[LikelihoodVolume], truths: NDArray[np.float64], outliers: float = 0.05
) -> float:
    """The concentration that makes the true poses (N, 3) most likely; as `fit_temperature`, `outliers` above zero."""
    _check_pairs(volumes, truths)
    patches = [_patch(volume, truth) for volume, truth in zip(volumes, truths, strict=True)]
    uniform = np.log(outliers) + np.array([log_uniform_density(volume.grid) for volume in volumes])

    def nll(log_concentration: float) -> float:
        powered = [with_heading_concentration(patch, math.exp(log_concentration)) for patch in patches]
        values = [patch.log_density(truth[None])[0] for patch, truth in zip(powered, truths, strict=True)]
        return -float(np.mean(np.logaddexp(np.log1p(-outliers) + np.array(values), uniform)))

    found = minimize_scalar(nll, bounds=_LOG_CONCENTRATION_BOUNDS, method="bounded", options={"xatol": 0.005})
    return float(np.exp(found.x))


def fit_calibration(
    volumes: Sequence[LikelihoodVolume], truths: NDArray[np.float64], factored: bool = False
) -> Calibration:
    """Fit everything on held-out likelihoods of a matcher that is not calibrated yet.

    Parameters
    ----------
    volumes, truths
        As `match_samples` gives them.
    factored
        Whether the headings get a concentration of their own, given the temperature.
    """
    temperature = fit_temperature(volumes, truths)
    tempered = [volume.tempered(temperature) for volume in volumes]
    concentration = fit_heading_concentration(tempered, truths) if factored else 1.0
    ready = [with_heading_concentration(volume, concentration) for volume in tempered]
    slope, intercept = fit_confidence([peak_mass(volume) for volume in ready], are_right(ready, truths))
    return Calibration(
        temperature=temperature,
        heading_concentration=concentration,
        confidence_slope=slope,
        confidence_intercept=intercept,
    )


def are_right(volumes: Sequence[LikelihoodVolume], truths: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the best mode of each is within `RIGHT_WITHIN_M` of the true position."""
    best = np.array([volume.modes(1).means[0, :2] for volume in volumes])
    return np.asarray(np.hypot(*(best - truths[:, :2]).T) < RIGHT_WITHIN_M)


def _check_pairs(volumes: Sequence[LikelihoodVolume], truths: NDArray[np.float64]) -> None:
    if len(volumes) == 0 or len(volumes) != len(truths):
        raise SkyfixError(f"calibration: expected as many volumes as truths, got {len(volumes)} and {len(truths)}")


def _patch(volume: LikelihoodVolume, truth: NDArray[np.float64]) -> LikelihoodVolume:
    """The positions that the interpolated density at a pose comes from: two by two cells, all headings."""
    grid = volume.grid
    if not grid.contains(truth[:2]) or min(grid.rows, grid.cols) < 2:
        raise SkyfixError(f"calibration: expected the true position inside the crop, got {truth[:2]}")
    row, col = np.clip(np.floor(grid.pixel_from_xy(truth[:2]) - 0.5), 0, (grid.rows - 2, grid.cols - 2)).astype(int)
    cell = grid.metres_per_pixel
    around = MapGrid(2, 2, cell, grid.x0 + col * cell, grid.y0 + (grid.rows - row - 2) * cell)
    return LikelihoodVolume(volume.log_prob[row : row + 2, col : col + 2], around, volume.floor)
