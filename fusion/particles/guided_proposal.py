"""Guided proposals: a share of the particles is drawn from the measurement itself, and weighed so that nothing is bent.

When a measurement is much sharper than the prediction, few predicted particles land on it. Drawing N (1 - a) particles
from the predictive density p and N a from a density q made of the measurement, and weighing all of them by

    w(x) = p(x) L(x) / ((1 - a) p(x) + a q(x))

(the balance heuristic) gives unbiased sums over p L, whatever q is, and weights at most L / (1 - a). The predictive
density of a cloud is a kernel estimate, `LatticeDensity`, and the predicted particles are drawn from that same
estimate, so the correction is exact for it.

Source: Thrun, Fox, Burgard, Dellaert, "Robust Monte Carlo localization for mobile robots", Artificial Intelligence
2001, section 4 (mixture MCL); Veach, Guibas, "Optimally combining sampling techniques", SIGGRAPH 1995, equation 9.
"""

import numpy as np

from fusion.arrays import FloatArray
from fusion.likelihood import PoseLikelihood
from fusion.particles.lattice_density import LatticeDensity


def guided(
    predicted: LatticeDensity, measurement: PoseLikelihood, count: int, share: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw poses (count, 3) and give their log weights (count,), whose exponentials have the evidence as their mean.

    Parameters
    ----------
    predicted : LatticeDensity
        The predictive density p.
    measurement : PoseLikelihood
        L, tempered and with outliers; q is what its `sample` draws from.
    count : int
        How many.
    share : float
        a, in (0, 1).
    rng : numpy Generator
        Source of randomness.
    """
    from_measurement = min(max(round(share * count), 1), count - 1) if count > 1 else 0
    a = from_measurement / count
    poses = predicted.sample(count - from_measurement, rng)
    if from_measurement:
        poses = np.concatenate([poses, measurement.sample(from_measurement, rng)])
    log_p, log_q = predicted.log_density(poses), measurement.draw_log_density(poses)
    with np.errstate(divide="ignore", invalid="ignore"):  # whoever asked looks at the weights
        log_proposal = np.logaddexp(np.log1p(-a) + log_p, np.log(a) + log_q)
    return poses, log_p + measurement.log_density(poses) - log_proposal
