"""One step of a grid filter, predict and update, on 64 headings of 256 x 256 cells, from a `LikelihoodVolume` on.

The peer is what one writes with scipy: every plane shifted by its rotated motion (`ndimage.shift`, linear) and blurred
(`gaussian_filter`), all planes turned and blurred across headings, then multiplied by the likelihood. Its layout is
that of skyfix, heading first, in float32. The motion is one that scipy can do as well: noise that is the same along and
across and independent of the heading's, and wide enough to take out of the blur what a linear shift adds to the
variance. Then both have nearly the same mean, covariance and posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from benchmarks.runner import Candidate, Case
from fusion import GridFilter, LikelihoodVolume, MapGrid, OdometryIncrement, PoseLattice, UniformPrior, se2
from fusion.arrays import Float32Array, FloatArray
from fusion.likelihood import log_uniform_density

CELLS = (64, 128, 256)
HEADINGS = 64
INCREMENT = OdometryIncrement(1, np.array([1.0, 0.1, 0.03]), np.diag([0.28, 0.28, 0.05]) ** 2)
PRIOR = UniformPrior(np.zeros(3), 10.0, 1.0)


def example_volume(cells: int, bins: int) -> LikelihoodVolume:
    """Two peaks of 2 m and 12 degrees, one of them twice as high, over clutter; cells of half a metre."""
    grid = MapGrid(cells, cells, 0.5, -0.25 * cells, -0.25 * cells)
    x, y = grid.centres()
    yaw = se2.TWO_PI * np.arange(bins) / bins
    scores = np.full((cells, cells, bins), -12.0)
    for x0, y0, yaw0, height in ((1.0, 0.0, 0.1, 0.0), (-5.0, 5.0, 0.7, -np.log(2.0))):
        squared = (x[None, :, None] - x0) ** 2 + (y[:, None, None] - y0) ** 2
        peak = height - squared / 8.0 + (np.cos(yaw - yaw0) - 1.0) / np.deg2rad(12.0) ** 2
        scores = np.logaddexp(scores, peak)
    return LikelihoodVolume.from_scores(scores, grid)


def skyfix_step(started: GridFilter, volume: LikelihoodVolume) -> float:
    """ln evidence of one step."""
    started.predict(INCREMENT)
    return started.update(volume).log_evidence


def _split(shift: float) -> float:
    """Variance that a linear shift by so many cells adds."""
    part = shift - np.floor(shift)
    return float(part * (1.0 - part))


@dataclass(slots=True, eq=False)
class ScipyFilter:
    """Mass (K, rows, cols) on cells that stay where they are."""

    mass: Float32Array
    lattice: PoseLattice
    outlier_probability: float
    kidnap_probability: float

    @classmethod
    def of(cls, ours: GridFilter) -> ScipyFilter:
        """The peer at the start of `ours`."""
        settings = ours.settings
        mass = ours.probabilities.copy()
        return cls(mass, ours.lattice, settings.outlier_probability, settings.kidnap_probability)

    def step(self, volume: LikelihoodVolume) -> float:
        """ln evidence of one step: predict, update."""
        self.predict()
        return self.update(volume)

    def predict(self) -> None:
        """Shift and blur."""
        cell, variance = self.lattice.cell, np.diag(INCREMENT.covariance)
        moved = se2.transform_points(
            np.column_stack([np.zeros((len(self.mass), 2)), self.lattice.headings]), INCREMENT.delta[:2]
        )
        for plane, (x, y) in zip(self.mass, moved / cell[:2], strict=True):
            sigmas = [np.sqrt(variance[0] / cell[0] ** 2 - _split(shift)) for shift in (-y, x)]
            shifted = ndimage.shift(plane, (-y, x), order=1)
            ndimage.gaussian_filter(shifted, sigmas, output=plane, mode="constant")
        turn = float(INCREMENT.delta[2] / cell[2])
        turned = ndimage.shift(self.mass, (turn, 0.0, 0.0), order=1, mode="grid-wrap")
        sigma = np.sqrt(variance[2] / cell[2] ** 2 - _split(turn))
        ndimage.gaussian_filter1d(turned, sigma, axis=0, output=self.mass, mode="wrap")

    def update(self, volume: LikelihoodVolume) -> float:
        """Multiply by the likelihood, outliers and jumps included; ln evidence."""
        weights = np.ascontiguousarray(volume.log_prob.transpose(2, 0, 1))
        np.exp(weights, out=weights)
        weights *= 1.0 - self.outlier_probability
        weights += self.outlier_probability * np.exp(log_uniform_density(volume.grid))
        self.mass *= 1.0 - self.kidnap_probability
        self.mass += self.kidnap_probability / self.mass.size
        self.mass *= weights
        evidence = float(self.mass.sum(dtype=np.float64))
        self.mass /= evidence
        return float(np.log(evidence))


def estimate(mass: Float32Array, lattice: PoseLattice) -> tuple[FloatArray, FloatArray]:
    """Mean (3,) and covariance (3, 3) of a mass on a lattice, cell by cell."""
    poses = np.concatenate([lattice.poses(plane) for plane in range(len(mass))])
    return se2.weighted_mean_and_covariance(poses, mass.ravel().astype(np.float64))


def cases(cells: Sequence[int] = CELLS, headings: int = HEADINGS) -> Iterator[Case]:
    """The step at each number of rows and columns; the size is the number of cells in all."""
    for count in cells:
        volume = example_volume(count, headings)
        yield Case("predict and update", headings * count**2, _candidates(volume))


def _candidates(volume: LikelihoodVolume) -> tuple[Candidate, ...]:
    headings = volume.log_prob.shape[2]

    def start() -> GridFilter:
        started = GridFilter.from_prior(PRIOR, volume.grid, headings)
        started.update(volume)
        return started

    def skyfix() -> Callable[[], float]:
        started = start()
        skyfix_step(started, volume)  # every later step finds its memory in place
        return lambda: skyfix_step(started, volume)

    def scipy() -> Callable[[], float]:
        peer = ScipyFilter.of(start())
        return lambda: peer.step(volume)

    return (Candidate("skyfix", skyfix), Candidate("scipy.ndimage shift + gaussian_filter", scipy))
