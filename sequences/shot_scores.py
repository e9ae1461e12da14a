"""What single shots are scored by: the answer, how likely the truth was, and whether stated chances came true.

A likelihood that a filter is to believe has to be right as a density. Its score for that is the negative log density
of the true pose per m^2 rad (lower is better; the prior's own is that of a uniform box), with and without the floor
that a filter mixes in; and the share of truths within its highest-density regions of nominal mass, see
`learned.reliability`. The chance that the best mode is right is scored by its expected calibration error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from fusion.particle_filter import ParticleFilterSettings
from learned.calibration import RIGHT_WITHIN_M, Calibration
from learned.matcher import SearchRegion
from learned.reliability import expected_calibration_error, highest_density_level, region_coverage
from sequences.measurement import best_pose
from sequences.metrics import summarise

THRESHOLDS = (1, 2, 3, 5)
"""Metres and degrees of single-shot recalls: 1, 3, 5 as in the KITTI tables, 2 and 5 as in ablations."""
OUTLIER_PROBABILITY = ParticleFilterSettings().outlier_probability
"""The share of the uniform density over crop and circle that filters mix in by default."""
_DIGITS = 6


@dataclass(frozen=True, slots=True, eq=False)
class ShotScore:
    """One answer to one scan.

    Attributes
    ----------
    pose
        (3,) the answer.
    nll, nll_with_floor
        Negative log density of the true pose per m^2 rad; the second of the mixture that a filter takes.
    level
        Mass of the smallest highest-density region that holds the truth; None where the density is uniform.
    chance, right
        Stated chance that the best mode is right (None where none is stated), and whether it is.
    """

    pose: FloatArray
    nll: float
    nll_with_floor: float
    level: float | None = None
    chance: float | None = None
    right: bool = False


def score_shot(likelihood: LikelihoodVolume, truth: FloatArray, calibration: Calibration | None = None) -> ShotScore:
    """Score a matcher's likelihood against the true pose (3,).

    The stated chance is the mass of the best mode, mapped by the calibration where there is one.
    """
    pose = onto_evaluated(likelihood, truth)
    best = likelihood.modes(1)
    mass = float(best.weights[0])
    away = best.means[0, :2] - truth[:2]
    return ShotScore(
        best_pose(likelihood),
        -float(likelihood.log_density(pose[None])[0]),
        -float(likelihood.with_outliers(OUTLIER_PROBABILITY).log_density(pose[None])[0]),
        highest_density_level(likelihood, pose),
        mass if calibration is None else calibration.chance(mass),
        bool(np.hypot(*away) < RIGHT_WITHIN_M),
    )


def score_prior(search: SearchRegion) -> ShotScore:
    """The box's own score: its centre is the answer, and the truth is uniform in it."""
    box = search.half_extent_m, search.half_heading_rad
    return ShotScore(np.asarray(search.centre, dtype=np.float64), box_nll(*box), box_nll(*box, OUTLIER_PROBABILITY))


def box_nll(half_extent_m: float, half_heading_rad: float, outliers: float = 0.0) -> float:
    """Negative log density, per m^2 rad, of a pose that is uniform in a box; of any pose in it.

    Parameters
    ----------
    half_extent_m, half_heading_rad
        Half sides of the box.
    outliers
        Share of the density that is uniform over all headings instead, as a filter's floor.
    """
    area = (2.0 * half_extent_m) ** 2
    return -math.log((1.0 - outliers) / (area * 2.0 * half_heading_rad) + outliers / (area * se2.TWO_PI))


def onto_evaluated(likelihood: LikelihoodVolume, pose: FloatArray) -> FloatArray:
    """A pose, its heading moved onto the outermost heading bin that was evaluated if it lies just beyond its centre.

    A range of headings ends between the centres of two bins, one of which was not searched. There, as at the edge
    of the crop, the last value holds: the floor beyond is no statement about this pose. The heading moves by less
    than a bin.
    """
    searched = likelihood.bin_peaks > likelihood.floor
    step = se2.TWO_PI / len(searched)
    below = math.floor(pose[2] / step)
    has_below, has_above = (bool(searched[k % len(searched)]) for k in (below, below + 1))
    if has_below == has_above:
        return pose
    return np.array([pose[0], pose[1], se2.wrap((below if has_below else below + 1) * step)])


def summarise_shots(truths: FloatArray, scores: Sequence[ShotScore], chance_source: str | None) -> dict[str, Any]:
    """The scores of one method as an object for JSON.

    Parameters
    ----------
    truths
        (N, 3) true poses.
    scores
        N of them.
    chance_source
        Where the stated chances come from, in words; None: none are stated.

    Returns
    -------
    What `metrics.summarise` gives, `likelihood` = {nll, nll_with_floor, outlier_probability, coverage: {"50", "90"}
    or None}, and with chances `confidence` = {source, mean, right, expected_calibration_error}.
    """
    if len(truths) != len(scores):
        raise SkyfixError(f"single shots: expected a score a truth, got {len(scores)} and {len(truths)}")
    summary = summarise(truths, np.array([score.pose for score in scores]), thresholds=THRESHOLDS)
    levels = [score.level for score in scores if score.level is not None]
    coverage = (
        {f"{100 * mass:g}": _rounded(share) for mass, share in region_coverage(levels).items()} if levels else None
    )
    summary["likelihood"] = {
        "nll": _rounded(np.mean([score.nll for score in scores])),
        "nll_with_floor": _rounded(np.mean([score.nll_with_floor for score in scores])),
        "outlier_probability": OUTLIER_PROBABILITY,
        "coverage": coverage,
    }
    if chance_source is not None:
        chances = np.array([score.chance for score in scores], dtype=np.float64)
        right = np.array([score.right for score in scores])
        summary["confidence"] = {
            "source": chance_source,
            "mean": _rounded(chances.mean()),
            "right": _rounded(right.mean()),
            "expected_calibration_error": _rounded(expected_calibration_error(chances, right)),
        }
    return summary


def _rounded(value: Any) -> float:
    return round(float(value), _DIGITS)
