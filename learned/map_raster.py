"""Maps as a network sees them: one class vocabulary, one palette, windows of any size.

Every source (OpenStreetMap, semantic rasters, segmented aerial images) is brought to the classes below and from there
to one 3-channel picture, so that one checkpoint serves them all. The palette is chosen so that the channels mean
something by themselves: red is how much a thing stands in the way of a laser (buildings, walls, fences), green is
vegetation, blue is ground that is paved. Aerial photographs have a picture and no classes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid

_PALETTE_BY_CLASS: dict[str, tuple[int, int, int]] = {
    "void": (0, 0, 0),
    "building": (170, 20, 30),
    "parking": (20, 20, 150),
    "grass": (10, 70, 20),
    "forest": (40, 140, 20),
    "water": (0, 60, 70),
    "road": (20, 20, 240),
    "path": (20, 60, 180),
    "wall": (255, 60, 60),
    "fence": (210, 110, 40),
    "hedge": (160, 200, 40),
    "tree": (90, 230, 60),
}
CLASSES: tuple[str, ...] = tuple(_PALETTE_BY_CLASS)
"""The vocabulary; a class raster holds indices into it. Building outlines are not a class: they are derived."""
PALETTE: NDArray[np.uint8] = np.array(list(_PALETTE_BY_CLASS.values()), dtype=np.uint8)
"""RGB of each class, shape (len(CLASSES), 3)."""
CLASS_INDEX: dict[str, int] = {name: index for index, name in enumerate(CLASSES)}
_LARGEST_SIDE = 32_766
"""OpenCV samples pictures of fewer than 2^15 - 1 pixels on a side."""


@dataclass(frozen=True, slots=True)
class MapRaster:
    """A georeferenced top-down map.

    Attributes
    ----------
    grid
        Where the pixels lie (map frame, metres; row 0 is north).
    classes
        (rows, cols) uint8 indices into `CLASSES`, or None where only a photograph is known.
    picture
        (rows, cols, 3) uint8 RGB.

    Raises
    ------
    SkyfixError
        If a raster's shape or type does not fit the grid.
    """

    grid: MapGrid
    classes: NDArray[np.uint8] | None
    picture: NDArray[np.uint8]

    def __post_init__(self) -> None:
        shape = (self.grid.rows, self.grid.cols)
        if self.picture.shape != (*shape, 3) or self.picture.dtype != np.uint8:
            raise SkyfixError(
                f"map picture: expected {(*shape, 3)} uint8, got {self.picture.shape} {self.picture.dtype}"
            )
        if self.classes is not None and (self.classes.shape != shape or self.classes.dtype != np.uint8):
            raise SkyfixError(f"map classes: expected {shape} uint8, got {self.classes.shape} {self.classes.dtype}")

    @classmethod
    def from_classes(cls, grid: MapGrid, classes: NDArray[np.uint8]) -> MapRaster:
        """Paint a class raster (rows, cols) with the fixed palette."""
        if classes.size and int(classes.max()) >= len(CLASSES):
            raise SkyfixError(f"map classes: expected indices below {len(CLASSES)}, got {int(classes.max())}")
        return cls(grid, classes, PALETTE[classes])

    @property
    def shows_buildings(self) -> bool:
        """Whether any building is on it; of a photograph it is taken for granted."""
        return self.classes is None or bool((self.classes == CLASS_INDEX["building"]).any())

    def crop(self, window: MapGrid) -> MapRaster:
        """Cut a window that is snapped to this map's pixels; what lies outside the map is void (black)."""
        row0, col0 = self.grid.offset_of(window)
        picture = _cut(self.picture, row0, col0, window.rows, window.cols)
        classes = None if self.classes is None else _cut(self.classes, row0, col0, window.rows, window.cols)
        return MapRaster(window, classes, picture)

    def resampled(self, window: MapGrid) -> MapRaster:
        """Sample any window at any resolution: nearest cell for classes, area average for pictures.

        A class that is one pixel wide on a finer map (a wall) survives coarsening only by luck, so bring maps to the
        resolution that they are matched at from vectors where vectors exist.

        Raises
        ------
        SkyfixError
            If the window, or what it needs of this map, has more than 32,766 pixels on a side.
        """
        ratio = window.metres_per_pixel / self.grid.metres_per_pixel
        if abs(ratio - 1.0) < 1e-9:
            return self.crop(window)
        rows, cols = np.mgrid[0 : window.rows, 0 : window.cols] + 0.5
        source = self.grid.pixel_from_xy(window.xy_from_pixel(np.stack([rows, cols], axis=-1)))
        first, last = _needed(source, (self.grid.rows, self.grid.cols), 2.0 * ratio)
        sides = (*(last - first).tolist(), window.rows, window.cols)
        if max(sides) > _LARGEST_SIDE:
            raise SkyfixError(
                f"map window: expected at most {_LARGEST_SIDE} pixels on a side, got {sides[2]} x {sides[3]} "
                f"from {sides[0]} x {sides[1]} of the map"
            )
        part = tuple(slice(*span) for span in zip(first, last, strict=True))
        source_rows, source_cols = ((source[..., axis] - first[axis] - 0.5).astype(np.float32) for axis in (0, 1))
        if self.classes is not None:
            sampled = cv2.remap(self.classes[part], source_cols, source_rows, cv2.INTER_NEAREST, borderValue=0)
            return MapRaster.from_classes(window, np.asarray(sampled, dtype=np.uint8))
        smooth = cv2.GaussianBlur(self.picture[part], (0, 0), 0.5 * ratio) if ratio > 1.5 else self.picture[part]
        picture = cv2.remap(smooth, source_cols, source_rows, cv2.INTER_LINEAR, borderValue=0)
        return MapRaster(window, None, np.asarray(picture, dtype=np.uint8))


def _needed(source: FloatArray, shape: tuple[int, int], reach: float) -> tuple[IntArray, IntArray]:
    """First and one past the last row and column that are sampled at `source` (rows, cols, 2), pixels.

    All of a map that OpenCV can sample. Of a larger one the part, with the reach of the blur about it; it begins at
    even pixels, for a half is rounded to the even one.
    """
    whole = np.array(shape)
    if whole.max() <= _LARGEST_SIDE:
        return np.zeros(2, np.int64), whole
    margin = np.ceil(reach) + 2.0
    first = np.clip(np.floor(source.min(axis=(0, 1)) - margin), 0.0, whole - 1.0).astype(np.int64)
    last = np.clip(np.ceil(source.max(axis=(0, 1)) + margin), 1.0, whole).astype(np.int64)
    first -= first % 2
    return first, np.maximum(last, first + 1)


def _cut(raster: NDArray[np.uint8], row0: int, col0: int, rows: int, cols: int) -> NDArray[np.uint8]:
    cut = np.zeros((rows, cols, *raster.shape[2:]), dtype=raster.dtype)
    top, left = max(row0, 0), max(col0, 0)
    bottom, right = min(row0 + rows, raster.shape[0]), min(col0 + cols, raster.shape[1])
    if bottom > top and right > left:
        cut[top - row0 : bottom - row0, left - col0 : right - col0] = raster[top:bottom, left:right]
    return cut
