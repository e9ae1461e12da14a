"""Sites: the Gaussian factors that stand for the measurements at the present estimate, and what is left without them.

Source: Minka, "Expectation propagation for approximate Bayesian inference", UAI 2001.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.graph.chain_algebra import OPTIONS, wrap
from fusion.graph.covariances import raised
from fusion.graph.inverses import inverses

_LEAST_SHARE = 1e-3  # of a marginal's information that stays when its own factor is taken out


@dataclass(frozen=True, slots=True, eq=False)
class Sites:
    """Factors ``exp(-1/2 d^T L d + h^T d)`` of deviations ``d = x - reference`` on the axes of the map, M in all.

    Parameters
    ----------
    reference : (M, 3) float64
        Poses.
    precision : (M, 3, 3) float64
        L, positive semidefinite.
    information : (M, 3) float64
        h.
    """

    reference: FloatArray
    precision: FloatArray
    information: FloatArray

    def about(self, poses: FloatArray) -> "Sites":
        """The same factors with other references (M, 3)."""
        moved = deviations(self.reference, poses)
        return Sites(poses, self.precision, self.information + np.einsum("mij,mj->mi", self.precision, moved))

    def mixed(self, other: "Sites", share: float) -> "Sites":
        """The geometric mean with others, which get a share in [0, 1]; about the others' references."""
        mine = self.about(other.reference)
        precision = (1.0 - share) * mine.precision + share * other.precision
        return Sites(other.reference, precision, (1.0 - share) * mine.information + share * other.information)

    def at(self, places: IntArray) -> "Sites":
        """Those at some places (K,)."""
        return Sites(self.reference[places], self.precision[places], self.information[places])

    def with_others(self, places: IntArray, others: "Sites") -> "Sites":
        """With others at some places (K,)."""
        found = Sites(self.reference.copy(), self.precision.copy(), self.information.copy())
        found.reference[places], found.precision[places] = others.reference, others.precision
        found.information[places] = others.information
        return found

    def costs(self, poses: FloatArray) -> FloatArray:
        """Minus the factors' logarithms (M,) at poses (M, 3)."""
        found = np.empty(len(poses))
        _costs(poses, self.reference, self.precision, self.information, found)
        return found

    def on_body_axes(self) -> tuple[FloatArray, FloatArray]:
        """Precision (M, 3, 3) and information (M, 3) for deviations on the axes of the references' bodies, GTSAM's."""
        back = se2.rotation(-self.reference[:, 2])
        return back @ self.precision @ back.swapaxes(1, 2), np.einsum("mij,mj->mi", back, self.information)

    def cavities(self, poses: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Marginals (M, 3), (M, 3, 3) with the own factor of each divided out."""
        own = self.about(poses)
        roots = np.linalg.cholesky(covariances)
        across = roots.swapaxes(1, 2)
        whitened = np.eye(3) - across @ own.precision @ roots
        cavity = roots @ inverses(raised(whitened, _LEAST_SHARE)) @ across
        centres = poses - np.einsum("mij,mj->mi", cavity, own.information)
        centres[:, 2] = se2.wrap(centres[:, 2])
        return centres, 0.5 * (cavity + cavity.swapaxes(1, 2))

    def log_integrals(self, centres: FloatArray, covariances: FloatArray) -> FloatArray:
        """ln of the factors' means (M,) over ``N(centres, covariances)``."""
        own = self.about(centres)
        roots = np.linalg.cholesky(covariances)
        across = roots.swapaxes(1, 2)
        total = np.eye(3) + across @ own.precision @ roots
        information = np.einsum("mij,mj->mi", across, own.information)
        gained = np.einsum("mi,mi->m", information, np.linalg.solve(total, information[..., None])[..., 0])
        return np.asarray(0.5 * (gained - np.linalg.slogdet(total)[1])) - self.costs(centres)


def deviations(poses: FloatArray, reference: FloatArray) -> FloatArray:
    """``poses - reference`` (..., 3), yaw the short way."""
    off = poses - reference
    off[..., 2] = se2.wrap(off[..., 2])
    return off


def no_sites(reference: FloatArray) -> Sites:
    """Factors of measurements that say nothing, at poses (M, 3)."""
    return Sites(reference, np.zeros((len(reference), 3, 3)), np.zeros((len(reference), 3)))


@numba.njit(**OPTIONS)
def _costs(
    poses: NDArray[np.float64],
    references: NDArray[np.float64],
    precisions: NDArray[np.float64],
    informations: NDArray[np.float64],
    costs: NDArray[np.float64],
) -> None:
    off = np.empty(3)
    for m in range(len(poses)):
        for i in range(3):
            off[i] = poses[m, i] - references[m, i]
        off[2] = wrap(off[2])
        total = 0.0
        for i in range(3):
            row = precisions[m, i, 0] * off[0] + precisions[m, i, 1] * off[1] + precisions[m, i, 2] * off[2]
            total += off[i] * (0.5 * row - informations[m, i])
        costs[m] = total
