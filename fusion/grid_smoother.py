"""Exact smoothing of a whole drive on a grid: forward-backward, per-time marginals, evidence and sampled paths.

Forward, the filter's messages ``a_t(x) = p(x_t, z_1..t)`` are stored; backward, ``b_t(x) = p(z_t+1.. | x_t)`` goes
through the adjoint of the motion. The marginals are their products, and they know the future: a wrong hypothesis that
the filter could not tell at the time is gone. Paths are drawn backward from the stored messages, each an exact draw
from the distribution of all drives that the grid can tell apart.

The drives are those that stay on the map and do not jump: what leaves the map ends there, and the evidence is that of
the measurements and of having stayed. Memory is eight bytes a cell and node.

Sources: Rabiner, "A tutorial on hidden Markov models", 1989, section III; Fruehwirth-Schnatter, "Data augmentation and
dynamic linear models", 1994 (backward sampling).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.arrays import Float32Array, FloatArray, read_only
from fusion.errors import SkyfixError
from fusion.grid_filter import GridFilter
from fusion.grids.grid_kernels import reweigh
from fusion.grids.grid_lookup import look_up
from fusion.grids.grid_moments import grid_moments
from fusion.grids.grid_motion import GridMotion
from fusion.grids.grid_paths import draw_cells, draw_sources
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.scratch import Scratch
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement
from fusion.trajectory import Trajectory, rising_stamps

_WHOLE = 2.0**100
_LEAST = 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class GridSmootherResult:
    """What the smoother found for N nodes.

    Parameters
    ----------
    trajectory : Trajectory
        Mean poses and covariances of the marginals, map frame.
    log_evidence : float
        ln density of all measurements together, times the probability of having stayed on the map.
    marginals : tuple of (K, rows, cols) float32
        Probability of every cell given all measurements, one a node; each sums to 1.
    filtered : tuple of (K, rows, cols) float32
        The same given the measurements up to the node, up to a factor.
    motions : tuple of GridMotion
        Between the nodes; `lattices` says where the cells of each node lie.
    """

    trajectory: Trajectory
    log_evidence: float
    marginals: tuple[Float32Array, ...]
    filtered: tuple[Float32Array, ...]
    motions: tuple[GridMotion, ...]
    lattices: tuple[PoseLattice, ...]

    def sample_paths(self, count: int, seed: int | np.random.Generator) -> FloatArray:
        """Draw whole drives, (count, N, 3): poses of cell centres, as probable together as the model says.

        Raises
        ------
        SkyfixError
            When the count is not positive.
        """
        if count < 1:
            raise SkyfixError(f"paths: expected a count >= 1, got {count}")
        rng = np.random.default_rng(seed)
        cells = draw_cells(self.filtered[-1], count, rng)
        poses = [self.lattices[-1].at(cells)]
        for filtered, motion, lattice in zip(
            self.filtered[-2::-1], self.motions[::-1], self.lattices[-2::-1], strict=True
        ):
            cells = draw_sources(filtered, motion, cells, rng)
            poses.append(lattice.at(cells))
        return np.stack(poses[::-1], axis=1)


def smooth_on_grid(
    start: GridFilter,
    first_stamp_ns: int,
    increments: Sequence[OdometryIncrement],
    likelihoods: Sequence[PoseLikelihood | None],
    temperatures: Sequence[float] | None = None,
) -> GridSmootherResult:
    """Smooth a drive of N nodes.

    Parameters
    ----------
    start : GridFilter
        The distribution at the first node, before its measurement; stays as it is. Its outlier probability counts.
    first_stamp_ns : int
        Time of the first node; the others have those of their increments.
    increments : sequence of OdometryIncrement
        The N - 1 motions between the nodes.
    likelihoods : sequence of PoseLikelihood or None
        One a node, as for a filter's update; None where nothing was measured.
    temperatures : sequence of float, optional
        One a node; 1 when left out.

    Raises
    ------
    SkyfixError
        When the counts do not match, stamps do not increase, a likelihood is not finite or rules everything out, or
        nothing stays on the map.
    """
    count = len(increments) + 1
    temperatures = [1.0] * count if temperatures is None else temperatures
    if len(likelihoods) != count or len(temperatures) != count:
        got = f"{len(likelihoods)} and {len(temperatures)}"
        raise SkyfixError(f"grid smoother: expected {count} likelihoods and temperatures, got {got}")
    outlier = start.settings.outlier_probability
    measurements = [
        None if likelihood is None else likelihood.tempered(temperature).with_outliers(outlier)
        for likelihood, temperature in zip(likelihoods, temperatures, strict=True)
    ]
    stamps = rising_stamps([first_stamp_ns, *(increment.stamp_ns for increment in increments)])

    scratch = Scratch()
    filtered, motions, log_evidence = _forward(start, increments, measurements, scratch)
    lattices = (start.lattice, *(motion.after for motion in motions))
    marginals = _backward(filtered, motions, lattices, measurements, scratch)
    moments = [grid_moments(*pair) for pair in zip(marginals, lattices, strict=True)]
    poses, covariances = [np.stack([getattr(one, name) for one in moments]) for name in ("pose", "covariance")]
    trajectory = Trajectory(stamps, poses, covariances)
    return GridSmootherResult(trajectory, log_evidence, marginals, filtered, motions, lattices)


def _forward(
    start: GridFilter,
    increments: Sequence[OdometryIncrement],
    measurements: Sequence[PoseLikelihood | None],
    scratch: Scratch,
) -> tuple[tuple[Float32Array, ...], tuple[GridMotion, ...], float]:
    mass, lattice = start.probabilities, start.lattice
    total = float(mass.sum(dtype=np.float64))  # in units of the mass, for a probability of exp(log_evidence) in all
    log_evidence = float(np.log(total))
    filtered: list[Float32Array] = []
    motions: list[GridMotion] = []
    for node, measurement in enumerate(measurements):
        if node:
            motion = GridMotion.on(lattice, increments[node - 1])
            moved = np.empty_like(mass)
            motion.apply(mass, moved, scratch, _WHOLE / total, _LEAST)
            motions.append(motion)
            mass, lattice = moved, motion.after
            total = float(mass.sum(dtype=np.float64))
            log_evidence += _log_share(
                total / _WHOLE, "increment: expected one that stays on the map, got one that leaves"
            )
        if measurement is not None:
            found = look_up(measurement, lattice, np.empty_like(mass), scratch)
            weighed, _ = reweigh(mass, found.weights, _WHOLE / total, 0.0, _LEAST)
            complaint = "likelihood: expected one that allows for the prediction, got one that rules it out"
            log_evidence += _log_share(weighed / _WHOLE, complaint) + found.log_scale
            mass, total = found.weights, weighed
        filtered.append(read_only(mass))
    return tuple(filtered), tuple(motions), log_evidence


def _log_share(share: float, complaint: str) -> float:
    if not (np.isfinite(share) and share > 1e-40):
        raise SkyfixError(complaint)
    return float(np.log(share))


def _backward(
    filtered: Sequence[Float32Array],
    motions: Sequence[GridMotion],
    lattices: Sequence[PoseLattice],
    measurements: Sequence[PoseLikelihood | None],
    scratch: Scratch,
) -> tuple[Float32Array, ...]:
    """Marginals of all nodes."""
    message = np.ones_like(filtered[-1])
    marginals = [_normalised(filtered[-1], message)]
    for node in range(len(filtered) - 1, 0, -1):
        measurement = measurements[node]
        if measurement is not None:
            weights = look_up(measurement, lattices[node], np.empty_like(message), scratch).weights
            reweigh(message, weights, 1.0, 0.0, _LEAST)
            message = weights
        earlier = np.empty_like(message)
        motions[node - 1].adjoint(message, earlier, scratch, 1.0 / float(message.max()))
        message = earlier
        marginals.append(_normalised(filtered[node - 1], message))
    return tuple(marginals[::-1])


def _normalised(mass: Float32Array, message: Float32Array) -> Float32Array:
    product = mass * message.astype(np.float64)
    product /= product.sum()
    return read_only(product.astype(np.float32))
