"""LikelihoodEmulator: measurements with a stated error profile about a true pose; no network, no map, no scan.

For trackers to be tried under errors that are known: what would a tracker make of a network with these recalls? The
density is calibrated by construction. A frame is ordinary or bad, the truth lies at the strongest mode or at a weaker
one, and the truth is a draw from exactly the density that the measurement states; the answer is placed accordingly.

Errors repeat from frame to frame as first-order autoregressions: every uniform number behind a frame is
``Phi(z)`` of a Gaussian z with ``z' = rho z + sqrt(1 - rho^2) e``, so that each frame alone is exactly the profile
(a Gaussian copula). Both how bad a frame is and where its answer lies are correlated, on the vehicle's axes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, ndtr

from fusion import se2
from fusion.arrays import FloatArray, checked
from fusion.emulation.emulated_likelihood import EmulatedLikelihood, cut_normal_quantile
from fusion.emulation.error_profile import ErrorProfile
from fusion.errors import SkyfixError

_FALSE_MODE_SIGMAS = 4.0  # where the weaker mode is cut off
_LEAST_WEIGHT = 1e-9


@dataclass(frozen=True, slots=True)
class EmulatorSettings:
    """What the profile leaves open.

    Parameters
    ----------
    correlation_length_m : float
        Distance over which the correlation of errors falls to 1/e; 0 for independent errors.
    step_correlation : float, optional
        Correlation from each measurement to the next, in [0, 1), whatever the distance; instead of the length.
    confidence_quality : float
        How well a measurement knows whether it is bad, in [0, 1]: the share of the variance of "bad" that its stated
        density explains. At 0 all state the same density, at 1 a bad one says so. Calibrated at any quality.
    overconfidence : float
        The stated standard deviations are the true ones divided by this; 1 is calibrated.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    correlation_length_m: float = 0.0
    step_correlation: float | None = None
    confidence_quality: float = 0.0
    overconfidence: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.correlation_length_m) and self.correlation_length_m >= 0.0):
            raise SkyfixError(f"correlation_length_m: expected >= 0, got {self.correlation_length_m}")
        if self.step_correlation is not None and not 0.0 <= self.step_correlation < 1.0:
            raise SkyfixError(f"step_correlation: expected in [0, 1), got {self.step_correlation}")
        if not 0.0 <= self.confidence_quality <= 1.0:
            raise SkyfixError(f"confidence_quality: expected in [0, 1], got {self.confidence_quality}")
        if not (np.isfinite(self.overconfidence) and self.overconfidence > 0.0):
            raise SkyfixError(f"overconfidence: expected > 0, got {self.overconfidence}")


class LikelihoodEmulator:
    """Draws one measurement after the other; the same seed and poses give the same ones.

    Parameters
    ----------
    profile : ErrorProfile
        How large errors are.
    seed : int or numpy Generator
        Source of all randomness.
    settings : EmulatorSettings
        How errors repeat and how honest the stated density is.
    """

    def __init__(
        self, profile: ErrorProfile, seed: int | np.random.Generator, settings: EmulatorSettings | None = None
    ) -> None:
        self.profile = profile
        self.settings = settings or EmulatorSettings()
        self._rng = np.random.default_rng(seed)
        self._latent = self._rng.standard_normal(9)

    def measure(self, true_pose: ArrayLike, moved_m: float = np.inf) -> EmulatedLikelihood:
        """The measurement at a pose.

        Parameters
        ----------
        true_pose : (3,) array_like
            ``[x, y, yaw]``, map frame.
        moved_m : float
            Distance driven since the previous measurement; infinite for errors that have nothing to do with its.

        Raises
        ------
        SkyfixError
            When the pose is not finite or the distance negative.
        """
        truth = checked("true pose", true_pose, (3,))
        rho = self._correlation(moved_m)
        self._latent = rho * self._latent + np.sqrt(1.0 - rho**2) * self._rng.standard_normal(9)
        share = ndtr(self._latent)
        profile, half = self.profile, self.profile.half_box
        core, tail = np.array(profile.core), np.array(profile.tail)
        false_half = np.minimum(_FALSE_MODE_SIGMAS * core, half)
        offset = (2.0 * share[6:] - 1.0) * (half - false_half)  # of the weaker mode, seen from the answer
        if not profile.heading_is_seen:
            false_half[2], offset[2] = half[2], 0.0
        tail_weight = self._stated_tail(share[0])
        if share[1] < profile.false_mode_share:
            seen = offset + cut_normal_quantile(share[3:6], core, false_half)
        else:
            seen = cut_normal_quantile(share[3:6], tail if share[2] < tail_weight else core, half)
        return self._stated(se2.compose(truth, se2.inverse(seen)), tail_weight, offset, false_half)

    def _correlation(self, moved_m: float) -> float:
        if not moved_m >= 0.0:
            raise SkyfixError(f"moved_m: expected >= 0, got {moved_m}")
        if self.settings.step_correlation is not None:
            return self.settings.step_correlation
        length = self.settings.correlation_length_m
        return float(np.exp(-moved_m / length)) if length > 0.0 else 0.0

    def _stated_tail(self, share: float) -> float:
        """The stated probability of a bad frame: Beta distributed about the tail's share, with a variance of `quality`
        times that of a coin."""
        quality, mean = self.settings.confidence_quality, self.profile.tail_share
        if quality == 0.0 or mean == 0.0:
            return mean
        if quality == 1.0:
            return float(share < mean)
        total = (1.0 - quality) / quality
        return float(betaincinv(mean * total, (1.0 - mean) * total, share))

    def _stated(
        self, answer: FloatArray, tail_weight: float, offset: FloatArray, false_half: FloatArray
    ) -> EmulatedLikelihood:
        profile = self.profile
        sigmas = np.array([profile.core, profile.tail, profile.core]) / self.settings.overconfidence
        halves = np.stack([profile.half_box, profile.half_box, false_half])
        centres = np.stack([np.zeros(3), np.zeros(3), offset])
        false = profile.false_mode_share
        weights = np.array([(1.0 - false) * (1.0 - tail_weight), (1.0 - false) * tail_weight, false])
        if not profile.heading_is_seen:
            sigmas[:, 2], halves[:, 2] = np.inf, np.pi
        used = weights > _LEAST_WEIGHT
        weights = weights[used] / weights[used].sum()
        return EmulatedLikelihood(answer, profile.half_box, weights, centres[used], sigmas[used], halves[used])
