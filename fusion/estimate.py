"""Estimate: what a filter says about the pose at one time."""

from dataclasses import dataclass

from fusion.arrays import FloatArray
from fusion.gaussian_mixture import GaussianMixture


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The state of a filter, summarised.

    Parameters
    ----------
    stamp_ns : int
        Time of the estimate.
    pose : (3,) float64
        Mean ``[x, y, yaw]``, map frame, circular in yaw.
    covariance : (3, 3) float64
        Covariance of ``[x, y, yaw]`` on the axes of the map.
    modes : GaussianMixture or None
        The separate clusters of the cloud, when it has been asked for them.
    effective_sample_size : float
        Number of equally weighted particles worth as much as the cloud.
    log_evidence : float
        ln density per m^2 rad that the last measurement gave to the prediction.
    lost_score : float
        Probability in [0, 1] that the filter is lost; the covariance does not say so. See `ParticleFilter`.
    """

    stamp_ns: int
    pose: FloatArray
    covariance: FloatArray
    modes: GaussianMixture | None
    effective_sample_size: float
    log_evidence: float
    lost_score: float
