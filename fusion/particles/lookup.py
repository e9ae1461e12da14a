"""A likelihood on a grid as the compiled filter step reads it: arrays, strides and a handful of constants.

Tempering and outliers need no new arrays: at a cell of log density l the filter weighs by

    (1 - p) exp(l / T - ln Z(T)) + p / V

where T is the temperature, Z(T) the integral of the density to the power 1 / T, p the probability of an outlier and V
the crop times all headings. So a lookup is the likelihood's own array and the two numbers 1 / T and ln Z(T).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, read_only
from fusion.grid import MapGrid
from fusion.kernels.layout import MAPS, NOTHING, VOLUME

MOST_CELLS = 2**31 - 1
"""Cells are counted in 32 bits."""
NO_TABLE = read_only(np.zeros(0, np.float32))
NO_SLOTS = read_only(np.zeros(0, np.int32))
NO_TABLES = (NOTHING, NO_TABLE, NO_TABLE, NO_SLOTS)
"""What the step is given of a lookup when there is none: the mode and the three arrays."""


@dataclass(slots=True, eq=False)  # made once a measurement: a frozen one takes twice as long to make
class Lookup:
    """Log densities of cells, and how to temper them.

    Parameters
    ----------
    table : (cells,) float32
        Log densities: per m^2 rad of a volume, headings side by side; of headings per rad at the pixels of maps.
    grid : MapGrid
        Where the pixels lie.
    bins : int
        Number of headings.
    scale, shift : float
        A log density l becomes ``scale * l + shift``.
    floor_before, floor : float
        Cells at `floor_before` or below were not evaluated; `floor` holds there and outside the crop.
    location : (rows * cols,) float32
        Log density per m^2 of each pixel, to which that of the headings is added; empty for a volume.
    slots : (rows * cols,) int32
        Which part of the table belongs to each pixel, for maps.
    pixel_stride, bin_stride : int
        Steps in the table from part to part and from heading to heading, for maps.
    """

    table: Float32Array
    grid: MapGrid
    bins: int
    scale: float
    shift: float
    floor_before: float
    floor: float
    location: Float32Array = field(default_factory=lambda: NO_TABLE)
    slots: NDArray[np.int32] = field(default_factory=lambda: NO_SLOTS)
    pixel_stride: int = 0
    bin_stride: int = 0

    def __post_init__(self) -> None:
        if self.table.flags.writeable or self.location.flags.writeable or self.slots.flags.writeable:
            for name in ("table", "location", "slots"):  # one kind of array, or the step is compiled once more
                setattr(self, name, read_only(getattr(self, name)))

    @property
    def mode(self) -> int:
        """Which of the compiled functions reads it."""
        return MAPS if len(self.location) else VOLUME

    def arguments(self, anchor: tuple[float, float], outlier_probability: float) -> list[float]:
        """The numbers of the compiled step, for positions relative to `anchor`."""
        grid, p = self.grid, outlier_probability
        rows, per_m = grid.rows, 1.0 / grid.metres_per_pixel
        west, south = anchor[0] - grid.x0, anchor[1] - grid.y0
        return [
            *(per_m, west * per_m, -per_m, rows - south * per_m, self.bins / se2.TWO_PI),
            *(self.scale, self.shift, self.floor_before, self.floor, 1.0 - p, p / (grid.area_m2 * se2.TWO_PI)),
            *(rows, grid.cols, self.bins, self.pixel_stride, self.bin_stride),
        ]


def lookup_of(likelihood: object, temperature: float, poses: Callable[[], FloatArray]) -> Lookup | None:
    """What the compiled step reads of a likelihood; None when it has to be asked for every particle instead.

    Parameters
    ----------
    likelihood
        One with a method ``lookup(temperature)``, or one that works its table out near poses (N, 3) only and has
        ``lookup_near(poses, temperature)``.
    temperature
        Flattens the likelihood.
    poses
        Gives the particles, when they are wanted.
    """
    whole, near = getattr(likelihood, "lookup", None), getattr(likelihood, "lookup_near", None)
    if whole is not None:
        return whole(temperature)
    return None if near is None else near(poses(), temperature)
