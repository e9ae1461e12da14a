"""Taps: a linear operator between planes of cells as a list of ways, each from a cell to another with its share.

At a heading all cells do the same, so a way is a source plane, a target plane, whole cells to go and a weight. Seen
from the targets it gathers mass, seen from the sources it is the adjoint: the same list, sorted the other way.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.grids.grid_kernels import gather

_TOGETHER = 8  # the compiled loop adds so many at a time


@dataclass(frozen=True, slots=True, eq=False)
class Taps:
    """What every plane adds up, padded to one length with weights of zero.

    Parameters
    ----------
    planes : (K, T) int64
        Plane to take from.
    cells : (K, T, 2) int64
        Rows and columns to take from, relative to the cell that is added to.
    weights : (K, T) float32
        Share that is added.
    """

    planes: IntArray
    cells: IntArray
    weights: Float32Array

    @classmethod
    def of(cls, owners: IntArray, planes: IntArray, cells: IntArray, weights: FloatArray, count: int) -> Self:
        """From a list of W ways (W,), (W,), (W, 2), (W,): plane that adds, plane taken from, cells, weight."""
        order = np.lexsort((cells[:, 1], cells[:, 0], planes, owners))
        owners = owners[order]
        sizes = np.bincount(owners, minlength=count)
        slot = np.arange(len(owners)) - (np.cumsum(sizes) - sizes)[owners]
        length = -(-int(sizes.max()) // _TOGETHER) * _TOGETHER
        of_plane = np.repeat(np.arange(count)[:, None], length, axis=1)
        of_plane[owners, slot] = planes[order]
        moved = np.zeros((count, length, 2), dtype=np.int64)
        moved[owners, slot] = cells[order]
        shares = np.zeros((count, length), dtype=np.float32)
        shares[owners, slot] = weights[order]
        return cls(of_plane, moved, shares)

    def apply(self, framed: Float32Array, out: Float32Array, floor: float = 0.0) -> float:
        """Gather `framed` (K, rows + 2 p, cols + 2 p) into `out` (K, rows, cols), at least `floor`; the sum."""
        frame = (framed.shape[1] - out.shape[1]) // 2
        height, width = framed.shape[1:]
        starts = (self.planes * height + frame + self.cells[..., 0]) * width + frame + self.cells[..., 1]
        return float(gather(framed.reshape(-1), width, starts, self.weights, out, floor))


@dataclass(frozen=True, slots=True, eq=False)
class Ways:
    """A list of W ways from cells to cells.

    Parameters
    ----------
    sources, targets : (W,) int64
        Planes.
    cells : (W, 2) int64
        Rows and columns to go.
    weights : (W,) float64
        Share of the source's mass; they add up to 1 for every source.
    count : int
        Number of planes.
    """

    sources: IntArray
    targets: IntArray
    cells: IntArray
    weights: FloatArray
    count: int

    @property
    def reach(self) -> int:
        """Rows or columns gone at most."""
        return int(np.abs(self.cells).max(initial=0))

    def gathering(self) -> Taps:
        """Seen from the targets."""
        return Taps.of(self.targets, self.sources, -self.cells, self.weights, self.count)

    def adjoint(self) -> Taps:
        """Seen from the sources."""
        return Taps.of(self.sources, self.targets, self.cells, self.weights, self.count)
