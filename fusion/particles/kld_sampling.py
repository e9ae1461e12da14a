"""How many particles does a cloud need? As many as its shape asks for, between two bounds.

With n draws the discrete distribution over k occupied cells is within `error` (Kullback-Leibler) of the true one with
the stated confidence when

    n >= (k - 1) / (2 error) * (1 - 2 / (9 (k - 1)) + sqrt(2 / (9 (k - 1))) z)^3

so draws are counted until their number has caught up with the cells that they have reached.

Source: Fox, "Adapting the sample size in particle filters through KLD-sampling", IJRR 2003, equation 8 (the
Wilson-Hilferty form of the chi-squared quantile) and table 1.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, keep_plain
from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True)
class KldSampling:
    """Bounds and accuracy of an adaptive number of particles.

    Parameters
    ----------
    least, most : int
        Bounds on the number of particles, 1 <= least <= most.
    error : float
        Kullback-Leibler divergence, in nats, that the cloud may have from the posterior; > 0.
    confidence : float
        With which it has not more, in (0.5, 1).
    cell_m, cell_rad : float
        Size of the cells over which this is measured; > 0.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    least: int = 500
    most: int = 100_000
    error: float = 0.02
    confidence: float = 0.99
    cell_m: float = 0.5
    cell_rad: float = float(np.deg2rad(5.0))

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        if not 1 <= self.least <= self.most:
            raise SkyfixError(f"adaptive: expected 1 <= least <= most, got {self.least} and {self.most}")
        if not 0.5 < self.confidence < 1.0:
            raise SkyfixError(f"adaptive confidence: expected in (0.5, 1), got {self.confidence}")
        for name in ("error", "cell_m", "cell_rad"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise SkyfixError(f"adaptive {name}: expected > 0, got {getattr(self, name)}")

    def sample_size(self, cells: FloatArray) -> FloatArray:
        """Number of draws (...) that so many occupied cells (...) ask for; 1 for a single cell."""
        free = np.maximum(np.asarray(cells, dtype=np.float64) - 1.0, 1e-9)
        ninth = 2.0 / (9.0 * free)
        quantile = NormalDist().inv_cdf(self.confidence)
        return np.where(free < 1.0, 1.0, free / (2.0 * self.error) * (1.0 - ninth + np.sqrt(ninth) * quantile) ** 3)

    def count(self, poses: FloatArray, weights: FloatArray, rng: np.random.Generator) -> int:
        """How many particles to draw from poses (N, 3) with weights (N,)."""
        cell = np.column_stack([np.floor(poses[:, :2] / self.cell_m), np.floor(se2.wrap(poses[:, 2]) / self.cell_rad)])
        cell -= cell.min(axis=0)
        _, rows, turns = (cell.max(axis=0) + 1.0).tolist()
        number = ((cell[:, 0] * rows + cell[:, 1]) * turns + cell[:, 2]).astype(np.int64)
        cumulative = np.cumsum(weights)
        points = rng.random(self.most) * cumulative[-1]
        drawn = number[np.minimum(np.searchsorted(cumulative, points, side="right"), len(number) - 1)]
        is_first = np.zeros(self.most, dtype=np.bool_)
        is_first[np.unique(drawn, return_index=True)[1]] = True
        enough = np.arange(1, self.most + 1) >= self.sample_size(np.cumsum(is_first))
        enough[: self.least - 1] = False
        return int(np.argmax(enough)) + 1 if enough.any() else self.most
