"""GridMotion: an odometry increment as a linear operator on probability mass over a lattice of poses.

The model is that of every filter here: ``pose' = pose * (delta + e)``, ``e ~ N(0, Q)``. At a fixed heading the motion
is the same for all cells, so the operator is two steps.

1. Every plane moves by its rotated `delta`: whole cells are moved, the rest becomes the plane's offset, and the turn
   turns the lattice. Nothing is split.
2. The noise is the dense convolution with Q, rotated into the plane: every cell gives to every other its share, see
   `fusion.grids.grid_noise`. What of a wide noise can be done before by blurs along lines of cells is done in step 1.

The shares are a Gaussian's at the cells' exact distances, fractions included, wherever the noise of the position is
wider than about 0.7 cells along every axis (given the heading); from single cells on, one motion is then the model's
sum over all pairs of cells within 1e-3 of total variation. Narrower noise is not Gaussian on cells, whoever puts it
there: its mean and covariance stay exact, so it adds up right over steps, and mass that is smooth at the scale of a
cell moves as it should. Where it is narrower than half a cell a heading error has to split mass between cells; the
variance ``f (1 - f)`` that this adds to a small share is taken out of the rest, as long as there is as much.

Source: Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, 8.2 (grid localization).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grids.grid_kernels import translate
from fusion.grids.grid_noise import GridNoise
from fusion.grids.pose_lattice import PoseLattice
from fusion.grids.scratch import Scratch
from fusion.grids.taps import Taps
from fusion.odometry import OdometryIncrement


@dataclass(frozen=True, slots=True, eq=False)
class GridMotion:
    """One increment on one lattice; made by :meth:`on`.

    Parameters
    ----------
    before, after : PoseLattice
        Where the cells lie before and after.
    steps : (K, 2) int64
        Whole cells that every plane moves by.
    noise : GridNoise
        What is done to the mass beside.
    gathering, adjoint_taps : Taps
        The ways of the noise seen from where they lead to, and from where they begin.
    """

    before: PoseLattice
    after: PoseLattice
    steps: IntArray
    noise: GridNoise
    gathering: Taps
    adjoint_taps: Taps

    @classmethod
    def on(cls, lattice: PoseLattice, increment: OdometryIncrement) -> Self:
        """The operator of `increment` for mass on `lattice`.

        Raises
        ------
        SkyfixError
            When the increment is less certain than the map is wide, or than half a turn.
        """
        position, heading = float(np.trace(increment.covariance[:2, :2])), float(increment.covariance[2, 2])
        widest = max(lattice.grid.width_m, lattice.grid.height_m)
        if position > widest**2 or heading > np.pi**2:
            deviation = f"{np.sqrt(position):.3g} m, {np.sqrt(heading):.3g} rad"
            raise SkyfixError(f"increment: expected deviations within {widest:g} m and pi rad, got {deviation}")
        axes = np.zeros((lattice.shape[0], 3, 3))  # from the body's (x, y, yaw) to (row, col, plane)
        axes[:, :2, :2] = _cells_from_xy(lattice.headings) / lattice.cell[0]
        axes[:, 2, 2] = 1.0 / lattice.cell[2]
        moved = lattice.offsets + axes[:, :2, :2] @ increment.delta[:2]
        steps = np.rint(moved)
        after = PoseLattice(lattice.grid, moved - steps, lattice.turned + float(increment.delta[2]))
        noise = GridNoise.of(axes @ increment.covariance @ axes.transpose(0, 2, 1), after.offsets)
        ways = noise.ways
        return cls(lattice, after, steps.astype(np.int64), noise, ways.gathering(), ways.adjoint())

    def apply(
        self, mass: Float32Array, out: Float32Array, scratch: Scratch, gain: float = 1.0, floor: float = 0.0
    ) -> float:
        """Mass (K, rows, cols) after the motion, times `gain` and at least `floor`, into `out`; what left the map."""
        reach = self.noise.ways.reach
        framed = _framed(mass.shape, reach, scratch)
        everything, edge = translate(mass, framed, self.steps, *self.noise.lines, gain, 2 * reach)
        arrived = self.gathering.apply(framed, out, floor)
        return min(max(everything - arrived, 0.0), edge)  # no more than came near the edge, for all that rounding does

    def adjoint(self, values: Float32Array, out: Float32Array, scratch: Scratch, gain: float = 1.0) -> None:
        """Expected value after the motion for every cell before it, times `gain`; zero beyond the map."""
        reach = self.noise.ways.reach
        framed = _framed(values.shape, 2 * reach, scratch)
        outer, inner = 2 * reach, slice(2 * reach, -2 * reach or None)
        framed[:, :outer] = framed[:, framed.shape[1] - outer :] = 0.0
        framed[:, :, :outer] = framed[:, :, framed.shape[2] - outer :] = 0.0
        framed[:, inner, inner] = values
        expected = np.empty_like(_framed(values.shape, reach, Scratch()))
        self.adjoint_taps.apply(framed, expected)
        translate(expected, out, -self.steps, *self.noise.lines, gain, 0)


def _framed(shape: tuple[int, ...], frame: int, scratch: Scratch) -> Float32Array:
    """Room for planes (K, rows, cols) inside a frame."""
    return scratch.take((shape[0], shape[1] + 2 * frame, shape[2] + 2 * frame))


def _cells_from_xy(headings: FloatArray) -> FloatArray:
    """Matrices (K, 2, 2) from body-frame (x, y) to (row, col): rows go against y."""
    cos, sin = np.cos(headings), np.sin(headings)
    return np.stack([np.stack([-sin, -cos], axis=-1), np.stack([cos, -sin], axis=-1)], axis=-2)
