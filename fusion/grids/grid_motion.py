"""GridMotion: an odometry increment as a linear operator on probability mass over a lattice of poses.

The model is that of every filter here: ``pose' = pose * (delta + e)``, ``e ~ N(0, Q)``. At a fixed heading the motion
is the same for all cells, so the operator is two steps.

1. Every plane moves by its rotated `delta` and is blurred by its rotated ``S = Q_pp - Q_pt Q_tp / Q_tt``, the spread of
   the position when the error of the heading is known. Whole cells are moved, the rest becomes the plane's offset. The
   blur with the full 2 x 2 covariance is three blurs along lines of cells (`fusion.grids.grid_kernels`).
2. Heading errors move shares of the mass to other planes; a share whose heading erred by e goes along with the position
   by its conditional mean ``Q_pt / Q_tt e``, which is how a heading error during the motion carries it sideways.
   The turn itself moves nothing: it turns the lattice.

Every kernel is a Gaussian sampled at whole cells whose width is chosen such that its variance is exact, however
narrow: ``(v / 2, 1 - v, v / 2)`` for v cells squared below a third. Means are exact. Only step 2 splits mass between
cells, as the planes' offsets differ; the variance ``f (1 - f)`` that it adds to its small share is taken out of the
blur of step 1. So the first two moments of the prediction at every heading are those of the model, as long as the blur
is wide enough to give that much, and no narrower across than 1/16 of its length (it is widened to that).

The shape is Gaussian only where the noise is about as wide as a cell. Narrower noise has the right variance but longer
tails, and a filter that goes on with it is somewhat too sure: by 5 % of the variance where the noise of a step has a
standard deviation of a quarter of a cell. Finer cells or longer steps cure that.

Source: Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, 8.2 (grid localization); the factorisation is that of a
Gaussian into a marginal and a conditional.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grids.grid_kernels import DIRECTIONS, mass_mixed_away, mix_headings, selling, translate
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.scratch import Scratch
from fusion.odometry import OdometryIncrement

_THREE_TAPS = 1.0 / 3.0  # variance in cells squared up to which three taps are enough
_RADIUS_SIGMAS = 5.0
_LEAST_VARIANCE = 1e-12  # cells squared; less is none
_LEAST_ASPECT = 1.0 / 256.0  # of the variances across and along
_NEWTON_STEPS = 12


def symmetric_taps(variances: FloatArray) -> Float32Array:
    """Halves of discrete Gaussians with exactly these variances, from the middle outward.

    Parameters
    ----------
    variances : (N,) float64
        Cells squared, >= 0.

    Returns
    -------
    (N, R + 1) float32
        Weight of the middle, of either neighbour, and so on: ``taps[0] + 2 taps[1:].sum() == 1``; zeros beyond the
        radius of a narrower one. R is at least 1.
    """
    widest = float(variances.max(initial=0.0))
    radius = 1 if widest <= _THREE_TAPS else int(np.ceil(_RADIUS_SIGMAS * np.sqrt(widest)))
    taps = np.zeros((len(variances), radius + 1))
    narrow = variances <= _THREE_TAPS
    taps[narrow, 1] = 0.5 * variances[narrow]
    wide = ~narrow
    if wide.any():
        taps[wide] = _sampled_gaussians(variances[wide], radius)
    half = taps.astype(np.float32)
    half[:, 0] = 1.0 - 2.0 * half[:, 1:].sum(axis=1, dtype=np.float64)
    return half


def _sampled_gaussians(variances: FloatArray, radius: int) -> FloatArray:
    """Gaussians sampled at 0 .. radius, each cut off at its own radius, whose variances are exact: Newton's method."""
    n = np.arange(radius + 1)
    inside = (n <= np.ceil(_RADIUS_SIGMAS * np.sqrt(variances))[:, None]).astype(np.float64)
    twice = np.where(n == 0, 1.0, 2.0)
    rate = 0.5 / variances  # weights exp(-rate n^2); d variance / d rate = variance^2 - fourth moment
    for _ in range(_NEWTON_STEPS):
        weights = inside * np.exp(-rate[:, None] * n**2)
        weights = weights / (weights @ twice)[:, None]
        second, fourth = weights @ (twice * n**2), weights @ (twice * n**4)
        rate = rate + (second - variances) / (fourth - second**2)
    weights = inside * np.exp(-rate[:, None] * n**2)
    return weights / (weights @ twice)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class _HeadingMix:
    """Step 2. Tables (K, M, 2) for M neighbours: whole cells, and the part that the next cell gets."""

    centre: float
    weights: Float32Array  # (M,)
    jumps: IntArray  # (M,) planes from the source to the target
    cells: IntArray  # (K, M, 2) by source plane: where mass goes
    parts: Float32Array

    @classmethod
    def of(cls, variance: float, carried: FloatArray, offsets: FloatArray) -> Self:
        """`variance` in planes squared; `carried` (K, 2) cells that a jump by one plane carries a source along."""
        half = symmetric_taps(np.array([variance]))[0]
        reach = int(np.flatnonzero(half).max())
        jumps = np.concatenate([np.arange(-reach, 0), np.arange(1, reach + 1)])
        targets = (np.arange(len(offsets))[:, None] + jumps) % len(offsets)
        shift = offsets[:, None] - offsets[targets] + carried[:, None] * jumps[:, None]
        cells = np.floor(shift)
        return cls(
            float(half[0]), half[np.abs(jumps)], jumps, cells.astype(np.int64), (shift - cells).astype(np.float32)
        )

    @property
    def excess(self) -> FloatArray:
        """Variance (K, 2) that splitting adds to the mass of each source plane, cells squared."""
        return np.einsum("m,kmi->ki", self.weights, self.parts * (1.0 - self.parts)).astype(np.float64)

    @property
    def frame(self) -> int:
        """Cells beyond the edge that are read."""
        return int(np.abs(self.cells).max(initial=0)) + 2

    def gathered(self) -> tuple[IntArray, IntArray, Float32Array]:
        """The same by target plane: source planes, and cells and parts to take the mass from."""
        planes = len(self.cells)
        sources = (np.arange(planes)[:, None] - self.jumps) % planes
        every = np.arange(len(self.jumps))
        return sources, -self.cells[sources, every] - 1, np.float32(1.0) - self.parts[sources, every]

    def transposed(self) -> tuple[IntArray, IntArray, Float32Array]:
        """Tables of the adjoint: every source collects from where its mass goes."""
        targets = (np.arange(len(self.cells))[:, None] + self.jumps) % len(self.cells)
        return targets, self.cells, self.parts


@dataclass(frozen=True, slots=True, eq=False)
class GridMotion:
    """One increment on one lattice; made by :meth:`on`.

    Parameters
    ----------
    before, after : PoseLattice
        Where the cells lie before and after.
    steps : (K, 2) int64
        Whole cells that every plane moves by.
    directions, taps, radii : (K, 3, 2) int64, (K, 3, R + 1) float32, (K, 3) int64
        The three blurs of every plane.
    mix : _HeadingMix or None
        What heading errors do; None when there are none.
    """

    before: PoseLattice
    after: PoseLattice
    steps: IntArray
    directions: IntArray
    taps: Float32Array
    radii: IntArray
    mix: _HeadingMix | None

    @classmethod
    def on(cls, lattice: PoseLattice, increment: OdometryIncrement) -> Self:
        """The operator of `increment` for mass on `lattice`.

        Raises
        ------
        SkyfixError
            When the increment is less certain than the map is wide, or than half a turn.
        """
        cell = lattice.cell
        cells_from_body = _cells_from_xy(lattice.headings) / cell[0]
        covariance, heading = increment.covariance[:2, :2], float(increment.covariance[2, 2])
        widest = max(lattice.grid.width_m, lattice.grid.height_m)
        if np.trace(covariance) > widest**2 or heading > np.pi**2:
            deviation = f"{np.sqrt(np.trace(covariance)):.3g} m, {np.sqrt(heading):.3g} rad"
            raise SkyfixError(f"increment: expected deviations within {widest:g} m and pi rad, got {deviation}")

        moved = lattice.offsets + cells_from_body @ increment.delta[:2]
        steps = np.rint(moved)
        after = PoseLattice(lattice.grid, moved - steps, lattice.turned + float(increment.delta[2]))
        mix = None
        spread = cells_from_body @ covariance @ cells_from_body.transpose(0, 2, 1)
        if heading > _LEAST_VARIANCE * cell[2] ** 2:
            along = increment.covariance[:2, 2] / heading
            covariance = covariance - heading * np.outer(along, along)
            spread = cells_from_body @ covariance @ cells_from_body.transpose(0, 2, 1)
            mix = _HeadingMix.of(heading / cell[2] ** 2, cells_from_body @ along * cell[2], after.offsets)
            spread = _less(spread, mix.excess)
        directions, variances = _lines(spread)
        taps = symmetric_taps(variances.ravel()).reshape(*variances.shape, -1)
        radii = (taps > 0.0).sum(axis=2) - 1
        return cls(lattice, after, steps.astype(np.int64), directions, taps, radii, mix)

    def apply(
        self, mass: Float32Array, out: Float32Array, scratch: Scratch, gain: float = 1.0, floor: float = 0.0
    ) -> float:
        """Mass (K, rows, cols) after the motion, times `gain` and at least `floor`, into `out`; what left the map."""
        if self.mix is None:
            return float(translate(mass, out, self.steps, self.directions, self.taps, self.radii, gain, floor))
        mix = self.mix
        framed = _framed(mass.shape, mix.frame, scratch)
        left = translate(mass, framed, self.steps, self.directions, self.taps, self.radii, gain, 0.0)
        left += mass_mixed_away(framed, mix.frame, mix.weights, mix.cells, mix.parts)
        mix_headings(framed, out, mix.centre, mix.weights, *mix.gathered(), floor)
        return float(left)

    def adjoint(self, values: Float32Array, out: Float32Array, scratch: Scratch, gain: float = 1.0) -> None:
        """Expected value after the motion for every cell before it, times `gain`; zero beyond the map."""
        if self.mix is not None:
            frame = self.mix.frame
            framed = _framed(values.shape, frame, scratch)
            framed[:, frame:-frame, frame:-frame] = values
            values = np.empty_like(values)
            mix_headings(framed, values, self.mix.centre, self.mix.weights, *self.mix.transposed(), 0.0)
        translate(values, out, -self.steps, self.directions, self.taps, self.radii, gain, 0.0)


def _framed(shape: tuple[int, ...], frame: int, scratch: Scratch) -> Float32Array:
    """Room for planes (K, rows, cols) inside a frame of zeros."""
    framed = scratch.take((shape[0], shape[1] + 2 * frame, shape[2] + 2 * frame))
    framed[:, :frame] = framed[:, -frame:] = 0.0
    framed[:, :, :frame] = framed[:, :, -frame:] = 0.0
    return framed


def _cells_from_xy(headings: FloatArray) -> FloatArray:
    """Matrices (K, 2, 2) from body-frame (x, y) to (row, col): rows go against y."""
    cos, sin = np.cos(headings), np.sin(headings)
    return np.stack([np.stack([-sin, -cos], axis=-1), np.stack([cos, -sin], axis=-1)], axis=-2)


def _less(spread: FloatArray, excess: FloatArray) -> FloatArray:
    """Covariances (K, 2, 2) less the diagonal `excess` (K, 2), or as much of it as leaves them semidefinite."""
    trace = np.trace(spread, axis1=1, axis2=2)[:, None, None]
    solid = spread + (_LEAST_VARIANCE + _LEAST_ASPECT * trace) * np.eye(2)
    ratio = np.linalg.eigvals(np.linalg.solve(solid, excess[:, :, None] * np.eye(2))).real.max(axis=1)
    share = np.minimum(1.0, (1.0 - _LEAST_ASPECT) / np.maximum(ratio, 1e-300))
    return np.asarray(spread - (share[:, None] * excess)[:, :, None] * np.eye(2))


def _lines(spread: FloatArray) -> tuple[IntArray, FloatArray]:
    """Directions (K, 3, 2) and variances (K, 3), zero where negligible, whose sum is each covariance (K, 2, 2)."""
    values, vectors = np.linalg.eigh(spread)
    values = np.maximum(values, np.maximum(_LEAST_ASPECT * values[:, 1:], _LEAST_VARIANCE))
    solid = np.einsum("kij,kj,klj->kil", vectors, values, vectors)
    directions = np.empty((len(spread), DIRECTIONS, 2), dtype=np.int64)
    variances = np.empty((len(spread), DIRECTIONS))
    selling(np.ascontiguousarray(solid), directions, variances)
    return directions, np.where(variances > 2.0 * _LEAST_VARIANCE, variances, 0.0)
