"""EmulatedLikelihood: a mixture of cut-off Gaussians about an answer, the density that emulated measurements have.

Everything is a density of the vehicle's pose seen from the answer, ``answer^-1 * pose`` = (forward, left, turned), so
that errors along and across the vehicle can differ. The map from there to poses on the map's axes is volume preserving.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp, ndtr, ndtri

from fusion import se2
from fusion.arrays import FloatArray, checked, keep_plain, read_only
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.likelihood import DEFAULT_FLOOR, OutlierMixture, checked_temperature

_GRID_CELLS = 64
_CELL_EDGES = np.array([-4.5, -3.0, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5])  # standard deviations
_BACKGROUND_CELLS = 12


def cut_normal_quantile(share: FloatArray, sigma: FloatArray, half: FloatArray) -> FloatArray:
    """Value below which `share` of ``N(0, sigma^2)`` cut off at +-`half` lies; an infinite sigma is uniform."""
    sigma, half = np.broadcast_arrays(np.asarray(sigma, dtype=np.float64), half)
    uniform = (2.0 * share - 1.0) * half
    below = ndtr(-half / sigma)
    normal = np.where(np.isinf(sigma), 1.0, sigma) * ndtri(below + share * (1.0 - 2.0 * below))
    return np.where(np.isinf(sigma), uniform, np.clip(normal, -half, half))


@dataclass(frozen=True, slots=True, eq=False)
class EmulatedLikelihood:
    """Weighted Gaussians with axes of their own, each cut off at a box; fits the protocol `PoseLikelihood`.

    Parameters
    ----------
    answer : (3,) float64
        Pose in the map frame that the components are about.
    half_box : (3,) float64
        The searched box about the answer, on the answer's axes: metres, metres, radians.
    weights : (C,) float64
        Mass of each component; sum 1.
    centres : (C, 3) float64
        Seen from the answer.
    sigmas : (C, 3) float64
        Standard deviations along the answer's axes; infinite for uniform.
    halves : (C, 3) float64
        Where each component is cut off; all stay in the searched box, but for headings.
    temperature : float
        The mixture is taken to the power 1 / temperature and normalised again.
    floor : float
        Least ln density per m^2 rad.

    Raises
    ------
    SkyfixError
        When shapes disagree or a weight or size is not positive.
    """

    answer: FloatArray
    half_box: FloatArray
    weights: FloatArray
    centres: FloatArray
    sigmas: FloatArray
    halves: FloatArray
    temperature: float = 1.0
    floor: float = DEFAULT_FLOOR
    log_peaks: FloatArray = field(init=False, repr=False)
    log_partition: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        keep_plain(self, ["temperature", "floor"])
        answer = checked("answer", self.answer, (3,)).copy()
        answer[2] = se2.wrap(answer[2])
        weights = checked("weights", self.weights, ("C",))
        centres = checked("centres", self.centres, (len(weights), 3))
        halves = checked("halves", self.halves, (len(weights), 3))
        half_box = checked("half box", self.half_box, (3,))
        sigmas = np.asarray(self.sigmas, dtype=np.float64)
        if sigmas.shape != centres.shape or not (sigmas > 0.0).all():
            raise SkyfixError(f"sigmas: expected ({len(weights)}, 3) positive numbers, got others")
        if len(weights) == 0 or weights.min() <= 0.0 or abs(weights.sum() - 1.0) > 1e-9:
            raise SkyfixError(f"weights: expected positive with a sum of 1, got {weights}")
        if halves.min() <= 0.0 or half_box.min() <= 0.0 or halves[:, 2].max() > np.pi:
            raise SkyfixError("halves: expected positive, at most pi for headings, got others")
        checked_temperature(self.temperature)
        kept = 1.0 - 2.0 * ndtr(-halves / sigmas)
        finite = np.where(np.isinf(sigmas), 1.0, sigmas)
        peaks = np.where(
            np.isinf(sigmas), 0.5 / halves, 1.0 / (np.sqrt(se2.TWO_PI) * finite * np.maximum(kept, 1e-300))
        )
        for name, value in (("answer", answer), ("half_box", half_box), ("weights", weights), ("centres", centres)):
            object.__setattr__(self, name, read_only(value))
        object.__setattr__(self, "sigmas", read_only(sigmas))
        object.__setattr__(self, "halves", read_only(halves))
        object.__setattr__(self, "log_peaks", read_only(np.log(weights) + np.log(peaks).sum(axis=1)))
        object.__setattr__(self, "log_partition", 0.0)
        if self.temperature != 1.0:
            object.__setattr__(self, "log_partition", float(logsumexp(self._cells()[2])))

    @property
    def grid(self) -> MapGrid:
        """The least square on the map's axes that holds the searched box."""
        yaw = self.answer[2]
        half = float(self.half_box[:2].max() * (abs(np.cos(yaw)) + abs(np.sin(yaw))))
        side = 2.0 * half / _GRID_CELLS
        return MapGrid(_GRID_CELLS, _GRID_CELLS, side, float(self.answer[0]) - half, float(self.answer[1]) - half)

    @property
    def searched_volume(self) -> float:
        """The searched square times the headings that a component reaches, m^2 rad."""
        return float(4.0 * self.half_box[0] * self.half_box[1] * 2.0 * self.halves[:, 2].max())

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) at poses (N, 3); the floor where every component is cut off."""
        seen = se2.between(self.answer, checked("poses", poses, ("N", 3)))
        return np.maximum(self._log_power(seen) - self.log_partition, self.floor)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3); of a tempered density by cells, uniformly inside each."""
        if self.temperature == 1.0:
            of = rng.choice(len(self.weights), size=n, p=self.weights)
            drawn = cut_normal_quantile(rng.random((n, 3)), self.sigmas[of], self.halves[of])
            return se2.compose(self.answer, self.centres[of] + drawn)
        low, sides, log_mass = self._cells()
        mass = np.exp(log_mass - log_mass.max())
        of = rng.choice(len(mass), size=n, p=mass / mass.sum())
        return se2.compose(self.answer, low[of] + rng.random((n, 3)) * sides[of])

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """`log_density`; draws of a tempered density differ from it within the cells that they are made by."""
        return self.log_density(poses)

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` highest components, with the moments that they have when cut off."""
        if k < 1:
            raise SkyfixError(f"modes: expected k >= 1, got {k}")
        chosen = np.argsort(-self.log_peaks, kind="stable")[:k]
        sigmas, halves = self.sigmas[chosen], self.halves[chosen]
        reach = halves / sigmas
        kept = np.maximum(1.0 - 2.0 * ndtr(-reach), 1e-300)
        lost = 2.0 * reach * np.exp(-0.5 * reach**2) / np.sqrt(se2.TWO_PI) / kept
        variances = np.where(
            np.isinf(sigmas), halves**2 / 3.0, np.where(np.isinf(sigmas), 1.0, sigmas) ** 2 * (1 - lost)
        )
        turn = se2.rotation(self.answer[2])
        covariances = turn @ (variances[:, :, None] * np.eye(3)) @ turn.T
        means = se2.compose(self.answer, self.centres[chosen])
        return GaussianMixture(self.weights[chosen], means, covariances).tempered(self.temperature)

    def tempered(self, temperature: float) -> "EmulatedLikelihood":
        """The density to the power 1 / temperature; normalised by cells, to about a percent, if it is a mixture."""
        if checked_temperature(temperature) == 1.0:
            return self
        if len(self.weights) == 1:
            return replace(self, sigmas=self.sigmas * np.sqrt(temperature))
        return replace(self, temperature=self.temperature * temperature)

    def with_outliers(self, probability: float) -> OutlierMixture:
        """Allow for a measurement that says nothing: mix in the uniform density over the crop."""
        return OutlierMixture(self, probability)

    def _log_power(self, seen: FloatArray) -> FloatArray:
        """ln of the mixture to the power 1 / T (N,) at poses seen from the answer; -inf where all is cut off."""
        terms = np.full((len(self.weights), len(seen)), -np.inf)
        for of, (centre, sigma, half) in enumerate(zip(self.centres, self.sigmas, self.halves, strict=True)):
            off = seen - centre
            off[:, 2] = se2.wrap(off[:, 2])
            inside = (np.abs(off) <= half).all(axis=1)
            squares = ((off[inside] / sigma) ** 2).sum(axis=1)
            terms[of, inside] = self.log_peaks[of] - 0.5 * squares
        highest = terms.max(axis=0)
        shift = np.where(np.isfinite(highest), highest, 0.0)
        total = np.exp(terms - shift).sum(axis=0)
        return np.where(total > 0.0, (shift + np.log(np.maximum(total, 1e-300))) / self.temperature, -np.inf)

    def _cells(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Lower corners (M, 3), sides (M, 3) and ln masses (M,) of cells that are fine where the density is."""
        edges = []
        for axis in range(3):
            sigma, centre = self.sigmas[:, axis, None], self.centres[:, axis, None]
            half = float(self.halves[:, axis].max())
            known = np.isfinite(sigma[:, 0])
            fine = (centre[known] + np.sqrt(self.temperature) * sigma[known] * _CELL_EDGES).ravel()
            coarse = np.linspace(-half, half, _BACKGROUND_CELLS + 1 if known.any() else 2)
            both = np.concatenate([fine[np.abs(fine) < half], coarse, (centre + self.halves[:, axis, None]).ravel()])
            both = np.concatenate([both, (centre - self.halves[:, axis, None]).ravel()])
            both = np.unique(np.round(both[np.abs(both) <= half], 9))
            edges.append(both)
        low = np.stack(np.meshgrid(*(edge[:-1] for edge in edges), indexing="ij"), axis=-1).reshape(-1, 3)
        sides = np.stack(np.meshgrid(*(np.diff(edge) for edge in edges), indexing="ij"), axis=-1).reshape(-1, 3)
        log_mass = self._log_power(low + 0.5 * sides) + np.log(sides).sum(axis=1)
        some = np.isfinite(log_mass)
        return low[some], sides[some], log_mass[some]
