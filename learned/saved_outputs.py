"""Likelihoods from outputs that other networks saved, with their conventions for axes and headings converted.

Two kinds of output are read, from .npy or .npz files (never unpickled):

- a joint volume over rows, columns and headings, as OrienterNet gives (Sarlin et al., CVPR 2023, equation 2);
- a location map with a field of (cos, sin) of the heading at every cell, as CCVPE gives (Xia et al., TPAMI 2024).

What a row, a column and a heading bin mean differs from program to program, so it has to be said, in a
`SavedConvention`. OrienterNet's is `ORIENTERNET`: (rows, columns, headings), row 0 in the north of a north-up tile,
heading 0 towards north and growing clockwise, bin k at 360 k / K degrees. For CCVPE none is given here, because its
data sets differ; plot one frame whose pose is known before you believe a choice.

The caller's grid says where the cells lie: the value at (row, column) belongs to the middle of that cell of a north-up
grid. For a program whose values belong to corners, shift the grid by half a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.location_orientation import LocationOrientationMaps
from learned.damaged_files import UNREADABLE

_YAW_OF = {"east": 0.0, "north": 0.5 * math.pi, "west": math.pi, "south": -0.5 * math.pi}
_LEAST_PROBABILITY = 1e-30
_EXCLUDED = -100.0
"""ln of how much less likely than the best place an excluded one is."""


@dataclass(frozen=True, slots=True)
class SavedConvention:
    """What the axes and values of a saved output mean; the defaults are skyfix's own.

    Attributes
    ----------
    axes
        Order of the axes: rows H, columns W and headings K, or the components K of a field. Axes of length one in
        front (a batch of one) are dropped.
    rows
        Whether rows go down (row 0 in the north) or up.
    heading_zero
        Where a heading of zero points.
    heading_turns
        In which sense headings grow, seen from above.
    first_heading_rad
        Heading of bin 0 of a volume, in that sense; bin k lies 2 pi k / K further on.
    values
        Log-probabilities (unnormalised will do) or probabilities.
    """

    axes: str = "HWK"
    rows: Literal["down", "up"] = "down"
    heading_zero: Literal["east", "north", "west", "south"] = "east"
    heading_turns: Literal["counter_clockwise", "clockwise"] = "counter_clockwise"
    first_heading_rad: float = 0.0
    values: Literal["log", "probability"] = "log"

    def __post_init__(self) -> None:
        if sorted(self.axes) != sorted("HWK"):
            raise SkyfixError(f"saved output: expected axes H, W and K in some order, got {self.axes!r}")
        chosen = (self.rows, self.heading_zero, self.heading_turns, self.values)
        known = (("down", "up"), tuple(_YAW_OF), ("counter_clockwise", "clockwise"), ("log", "probability"))
        for choice, choices in zip(chosen, known, strict=True):
            if choice not in choices:
                raise SkyfixError(f"saved output: expected one of {', '.join(choices)}, got {choice!r}")
        if not math.isfinite(self.first_heading_rad):
            raise SkyfixError(f"saved output: expected a finite first heading, got {self.first_heading_rad}")

    @property
    def sense(self) -> int:
        """1 where headings grow as yaw does, -1 where they fall."""
        return 1 if self.heading_turns == "counter_clockwise" else -1


ORIENTERNET = SavedConvention("HWK", "down", "north", "clockwise")
"""OrienterNet's volume of log-probabilities."""


def volume_from_array(array: NDArray[Any], grid: MapGrid, convention: SavedConvention) -> LikelihoodVolume:
    """Likelihood of a joint volume.

    Parameters
    ----------
    array
        Log-probabilities or probabilities; -inf and 0 count as not evaluated.
    grid
        Where the cells lie, row 0 in the north.
    convention
        What the array's axes and values mean.

    Raises
    ------
    SkyfixError
        If the shape is not the grid's, a value is NaN or +inf, a probability is negative or all cells are excluded.
    """
    cells = _north_up(array, grid, convention)
    log_values = _log_values(cells, convention.values)
    valid = np.isfinite(log_values)
    if not valid.any():
        raise SkyfixError("saved volume: expected a cell with a probability above zero, got none")
    scores, known = _on_yaw_bins(np.where(valid, log_values, 0.0), valid, convention)
    return LikelihoodVolume.from_scores(scores, grid, valid=known)


def maps_from_field(
    location: NDArray[Any],
    heading: NDArray[Any],
    grid: MapGrid,
    convention: SavedConvention,
    heading_std_deg: float,
    yaw_bins: int = 72,
) -> LocationOrientationMaps:
    """Likelihood of a location map and a field of headings.

    Such a network gives no spread of the heading, so each cell gets a von Mises density about its direction whose
    concentration is 1 / standard deviation^2; a zero vector gets the uniform density.

    Parameters
    ----------
    location
        (H, W), or (W, H) where the convention's axes say so: log-probabilities or probabilities.
    heading
        cos and sin of the heading, in the order of the convention's axes with K = 2; of any length.
    grid, convention
        As for `volume_from_array`.
    heading_std_deg
        Standard deviation of the heading error, from held-out data.
    yaw_bins
        Heading bins over the full circle.

    Raises
    ------
    SkyfixError
        If a shape is not the grid's, a value is not finite, or the spread is not positive.
    """
    if not (math.isfinite(heading_std_deg) and heading_std_deg > 0):
        raise SkyfixError(f"heading spread: expected a positive number of degrees, got {heading_std_deg}")
    field = _north_up(heading, grid, convention)
    if field.shape[2] != 2 or not np.isfinite(field).all():
        raise SkyfixError(f"saved heading: expected finite (cos, sin), K = 2, got {np.shape(heading)}")
    if np.ndim(location) < 2:
        raise SkyfixError(f"saved location: expected ({grid.rows}, {grid.cols}), got {np.shape(location)}")
    places = _north_up(np.expand_dims(location, convention.axes.index("K") - 3), grid, convention)[..., 0]
    log_location = _log_values(places, convention.values)
    if np.isneginf(log_location).all():
        raise SkyfixError("saved location: expected a cell with a probability above zero, got none")
    log_location = np.maximum(log_location, log_location.max() + _EXCLUDED)
    log_location -= logsumexp(log_location) + 2 * np.log(grid.metres_per_pixel)
    length = np.hypot(field[..., 0], field[..., 1])
    angle = np.arctan2(field[..., 1], field[..., 0])
    yaw = _YAW_OF[convention.heading_zero] + convention.sense * angle
    bins = np.arange(yaw_bins)[:, None, None] * (2 * np.pi / yaw_bins)
    concentration = np.where(length > 0, np.radians(heading_std_deg) ** -2, 0.0)
    orientation = concentration * np.cos(bins - yaw)
    orientation -= logsumexp(orientation, axis=0) + np.log(2 * np.pi / yaw_bins)
    return LocationOrientationMaps(log_location.astype(np.float32), orientation.astype(np.float32), grid)


def load_volume(path: Path, grid: MapGrid, convention: SavedConvention, key: str | None = None) -> LikelihoodVolume:
    """`volume_from_array` of a file: a .npy, or the array `key` (the only one, if left out) of an .npz."""
    return volume_from_array(_load(path, key), grid, convention)


def load_field(
    path: Path,
    grid: MapGrid,
    convention: SavedConvention,
    heading_std_deg: float,
    yaw_bins: int = 72,
    keys: tuple[str, str] = ("location", "heading"),
) -> LocationOrientationMaps:
    """`maps_from_field` of an .npz that holds the location map and the field under `keys`."""
    location, heading = (_load(path, key) for key in keys)
    return maps_from_field(location, heading, grid, convention, heading_std_deg, yaw_bins)


def _load(path: Path, key: str | None) -> NDArray[Any]:
    """One array of a file, read without unpickling."""
    try:
        with path.open("rb") as file:
            content = np.load(file, allow_pickle=False)
            if isinstance(content, np.ndarray):
                if key is not None:
                    raise SkyfixError(f"{path.name}: expected an .npz with an array {key!r}, got a single array")
                return content
            names = content.files
            chosen = names[0] if key is None and len(names) == 1 else key
            if chosen not in names:
                wanted = "one array or a key" if key is None else f"an array {key!r}"
                raise SkyfixError(f"{path.name}: expected {wanted}, got {', '.join(names) or 'no arrays'}")
            return np.asarray(content[chosen])
    except UNREADABLE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SkyfixError(f"{path.name}: expected a readable .npy or .npz of numbers, got: {reason}") from error


def _north_up(array: NDArray[Any], grid: MapGrid, convention: SavedConvention) -> NDArray[np.float64]:
    """Bring an array to (rows from the north, columns, K), float64, and check it against the grid."""
    values = np.asarray(array)
    while values.ndim > 3 and values.shape[0] == 1:
        values = values[0]
    sizes = {"H": str(grid.rows), "W": str(grid.cols), "K": "K"}
    expected = f"({', '.join(sizes[axis] for axis in convention.axes)})"
    if values.ndim != 3 or not (np.issubdtype(values.dtype, np.floating) or np.issubdtype(values.dtype, np.integer)):
        raise SkyfixError(f"saved output: expected {expected} numbers, got {values.shape} {values.dtype}")
    ordered = values.transpose([convention.axes.index(axis) for axis in "HWK"]).astype(np.float64)
    if ordered.shape[:2] != (grid.rows, grid.cols) or ordered.shape[2] < 1:
        raise SkyfixError(f"saved output: expected {expected}, got {values.shape}")
    return ordered if convention.rows == "down" else ordered[::-1]


def _log_values(values: NDArray[np.float64], kind: str) -> NDArray[np.float64]:
    """Natural logarithms; what has no probability is -inf."""
    if np.isnan(values).any() or np.isposinf(values).any():
        raise SkyfixError("saved output: expected no NaN and no +inf, got some")
    if kind == "log":
        return values
    if (values < 0).any():
        raise SkyfixError(f"saved output: expected probabilities of at least 0, got {values.min():g}")
    return np.where(values > _LEAST_PROBABILITY, np.log(np.maximum(values, _LEAST_PROBABILITY)), -np.inf)


def _on_yaw_bins(
    scores: NDArray[np.float64], valid: NDArray[np.bool_], convention: SavedConvention
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Headings renumbered to yaw bins (bin 0 = +x, counter-clockwise), interpolated where bins fall between."""
    count = scores.shape[2]
    zero = _YAW_OF[convention.heading_zero] + convention.sense * convention.first_heading_rad
    yaw = np.arange(count) * (2 * np.pi / count)
    source = convention.sense * (yaw - zero) * count / (2 * np.pi)
    below = np.floor(source + 1e-9)
    part = np.clip(source - below, 0.0, 1.0)
    part[part < 1e-6] = 0.0
    low, high = (below.astype(int) + step for step in (0, 1))
    low, high = low % count, high % count
    known = valid[:, :, low] & (valid[:, :, high] | (part == 0.0))
    return scores[:, :, low] * (1 - part) + scores[:, :, high] * part, known
