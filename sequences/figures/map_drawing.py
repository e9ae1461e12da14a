"""Maps to draw on: pale colours for people, with a scale bar and an arrow to the north."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from fusion.grid import MapGrid
from fusion.prior import UniformPrior
from learned.map_raster import CLASSES, MapRaster
from sequences.figures.style import INK, METHODS

_CARTOGRAPHY = {
    "void": "#e9e6de",
    "building": "#cbbcab",
    "parking": "#dedbe8",
    "grass": "#dcebcb",
    "forest": "#bcd8a6",
    "water": "#b9d6ea",
    "road": "#ffffff",
    "path": "#f3e7cd",
    "wall": "#857260",
    "fence": "#a8957f",
    "hedge": "#8fb676",
    "tree": "#a3cc86",
}
_CLASS_COLOURS: NDArray[np.uint8] = np.array(
    [[int(_CARTOGRAPHY[name][i : i + 2], 16) for i in (1, 3, 5)] for name in CLASSES], dtype=np.uint8
)


def for_people(raster: MapRaster) -> NDArray[np.uint8]:
    """Paint a map to draw on: pale cartographic colours where classes are known, else a lightened photograph.

    Returns
    -------
    (rows, cols, 3) uint8 RGB, row 0 north.
    """
    if raster.classes is not None:
        return _CLASS_COLOURS[raster.classes]
    return (255 - (255 - raster.picture.astype(np.float32)) * 0.55).astype(np.uint8)


def extent_of(grid: MapGrid) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of a grid in metres, as imshow wants it."""
    return grid.x0, grid.x0 + grid.width_m, grid.y0, grid.y0 + grid.height_m


def draw_map(axes: Axes, raster: MapRaster) -> None:
    """Paint a map in its place; what lies around it gets the colour of void."""
    axes.imshow(for_people(raster), extent=extent_of(raster.grid), zorder=0, interpolation="antialiased")
    axes.set_facecolor(_CARTOGRAPHY["void"])


def scale_bar(axes: Axes) -> None:
    """Draw a bar of a round length, about a fifth of the width, in the lower left corner."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    length = round_length((right - left) / 5.0)
    x, y = left + 0.04 * (right - left), bottom + 0.045 * (top - bottom)
    axes.plot([x, x + length], [y, y], color="white", lw=6.5, solid_capstyle="butt", zorder=13)
    axes.plot([x, x + length], [y, y], color=INK, lw=3.5, solid_capstyle="butt", zorder=14)
    axes.annotate(
        f"{length:g} m",
        (x + length / 2, y),
        xytext=(0, 5),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        color=INK,
        zorder=14,
    )


def round_length(target_m: float) -> float:
    """Find the largest of 1, 2 or 5 times a power of ten that is not above `target_m`."""
    power = 10.0 ** np.floor(np.log10(target_m))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= target_m * (1 + 1e-9)))


def draw_prior(axes: Axes, prior: UniformPrior) -> None:
    """Outline the box of positions that the run started from."""
    style, half = METHODS["prior"], prior.half_extent_m
    corner = (float(prior.centre[0]) - half, float(prior.centre[1]) - half)
    box = Rectangle(corner, 2 * half, 2 * half, fill=False, ec=style.colour, lw=style.width, label=style.label)
    box.set_zorder(style.layer)
    axes.add_patch(box)


def north_arrow(axes: Axes) -> None:
    """Draw an arrow to the top with an N, in the upper left corner."""
    axes.annotate(
        "N",
        xy=(0.035, 0.97),
        xytext=(0.035, 0.885),
        xycoords="axes fraction",
        ha="center",
        va="center",
        fontsize=10,
        fontweight="bold",
        color=INK,
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.6},
        zorder=14,
    )
