"""Search of a whole map: every pose scored on coarse cells, and the best places again on the vote's own cells.

Around the best coarse cells, and around poses that somebody asks about, each is cut into the cells of the ordinary
vote, whose scores are those of a narrow search. A coarse score is a mean of log densities (`coarse_vote`) and so less
than the log of a mean: what the cut places gain by it, in the median, is granted to all the others.

The spectra of the map are worked out once, so the map's features should be handed over once for a drive. Source of the
two steps: Olson, "Real-time correlative scan matching", ICRA 2009, section V (many-to-one resolutions).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.two_level import TwoLevelLikelihood
from learned.coarse_vote import CoarseVote, padded_size
from learned.correlation import MapCorrelator, fast_length, template_spectrum
from learned.voting import prior_scores, rotate_templates

_NEAR_M, _NEAR_RAD = 10.0, math.radians(10.0)
MOST_CELLS = 100_000_000
"""Of the coarse level: 400 MB."""


@dataclass(frozen=True, slots=True)
class MapSearchSettings:
    """How finely.

    Attributes
    ----------
    cell_m, heading_deg
        Wanted size of a coarse cell; an odd number of the vote's cells is taken.
    places
        At most so many of the best coarse cells are looked at closely, with their neighbours on all sides.
    range_nats
        Cells this far below the best are not looked at closely.
    contrast_cell_m, contrast_heading_deg, contrast_places
        Wanted size of a cell where only the contrast is asked for, and how many places are then looked at closely:
        coarser and fewer, as it is asked for often.
    """

    cell_m: float = 3.0
    heading_deg: float = 5.0
    places: int = 16
    range_nats: float = 12.0
    contrast_cell_m: float = 5.0
    contrast_heading_deg: float = 9.0
    contrast_places: int = 6

    def __post_init__(self) -> None:
        if not all(getattr(self, entry.name) > 0 for entry in fields(self)):
            raise SkyfixError(f"map search: expected positive settings, got {self}")


@dataclass(frozen=True, slots=True)
class MapLattice:
    """Where the cells of a whole-map search lie, and the window of map features that it needs.

    Attributes
    ----------
    coarse
        The coarse cells; they cover the map.
    window
        Of the features, `feature_m` a cell.
    side, turn
        The vote's cells and yaw bins in a coarse one, both odd.
    template, padded
        Cells of the scan's features on a side; made a multiple of 2 `side`.
    """

    coarse: MapGrid
    window: MapGrid
    side: int
    turn: int
    template: int
    padded: int

    @classmethod
    def over(
        cls,
        grid: MapGrid,
        feature_m: float,
        template: int,
        yaw_bins: int,
        multiple_of: int,
        settings: MapSearchSettings,
    ) -> MapLattice:
        """Lay cells over the map `grid`; the window's sides are multiples of so many features."""
        side = _odd(settings.cell_m / feature_m)
        turn = _bins_together(yaw_bins, settings.heading_deg)
        padded = padded_size(template, side)
        if grid.area_m2 * yaw_bins / turn > MOST_CELLS * (side * feature_m) ** 2:
            expected = f"at most {MOST_CELLS * (side * feature_m) ** 2 * turn / yaw_bins * 1e-6:.0f} km^2"
            raise SkyfixError(f"whole-map search: expected a map of {expected}, got {grid.area_m2 * 1e-6:.0f} km^2")
        cell = side * feature_m
        rows, cols = (math.ceil(extent / cell) + 1 for extent in (grid.height_m, grid.width_m))
        height, width = (multiple_of * math.ceil((padded + side * (count + 1)) / multiple_of) for count in (rows, cols))
        # The first coarse cell that is used is the second: its neighbours' fine cells lie in the window as well.
        inset = (padded / 2 + side / 2) * feature_m
        x0 = grid.x0 - inset - 0.5 * (cols * cell - grid.width_m)
        top = grid.y0 + grid.height_m + inset + 0.5 * (rows * cell - grid.height_m)
        x0 = grid.x0 + round((x0 - grid.x0) / grid.metres_per_pixel) * grid.metres_per_pixel
        top = grid.y0 + round((top - grid.y0) / grid.metres_per_pixel) * grid.metres_per_pixel
        window = MapGrid(height, width, feature_m, x0, top - height * feature_m)
        coarse = MapGrid(rows, cols, cell, x0 + inset, top - inset - rows * cell)
        return cls(coarse, window, side, turn, template, padded)

    @property
    def first(self) -> int:
        """Where the template of the first fine cell begins in the window, along rows and columns alike."""
        return self.side + (self.padded - self.template) // 2 - self.side // 2


class MapSearch:
    """A map's features, ready to be searched with scans.

    Parameters
    ----------
    features
        (C, H, W) of the lattice's window.
    lattice
        From `MapLattice.over`.
    yaw_bins, temperature
        Of the vote.
    settings
        How finely.
    prior
        (H, W) log-prior of the vehicle standing in a cell, or None.
    """

    def __init__(
        self,
        features: Tensor,
        lattice: MapLattice,
        yaw_bins: int,
        temperature: float,
        settings: MapSearchSettings,
        prior: Tensor | None = None,
    ) -> None:
        wanted = (lattice.window.rows, lattice.window.cols)
        if features.ndim != 3 or tuple(features.shape[1:]) != wanted:
            raise SkyfixError(f"map features: expected (C, {wanted[0]}, {wanted[1]}), got {tuple(features.shape)}")
        self._features, self.lattice, self.settings = features, lattice, settings
        self._yaw_bins, self._temperature = yaw_bins, temperature
        self._coarse = CoarseVote(features, lattice.window, lattice.template, lattice.side, yaw_bins // lattice.turn)
        side = _odd(settings.contrast_cell_m / lattice.window.metres_per_pixel)
        bins = yaw_bins // _bins_together(yaw_bins, settings.contrast_heading_deg)
        self._contrast = CoarseVote(features, lattice.window, lattice.template, side, bins)
        self._prior = None if prior is None else self._prior_of_cells(prior)

    def likelihood(self, scan: Tensor, near: FloatArray | None = None) -> TwoLevelLikelihood:
        """Score all poses for a scan's features (C, n, n); the cells at poses `near` (M, 3) are cut in any case."""
        if scan.shape[-1] != self.lattice.template:
            expected = f"(C, {self.lattice.template}, {self.lattice.template})"
            raise SkyfixError(f"scan features: expected {expected}, got {tuple(scan.shape)}")
        with torch.inference_mode():
            coarse = self._coarse_scores(scan)
            centres = self._best_places(coarse, self.settings.places)
            if near is not None and len(near):
                centres = np.unique(np.concatenate([centres, self._cells_of(near)]), axis=0)
            cut, fine = self._closely(scan, centres)
        gained = _log_mean(fine) - coarse[tuple(cut.T)]
        lifted = coarse + np.float32(np.median(gained))
        return TwoLevelLikelihood.from_scores(lifted, self.lattice.coarse, cut, fine)

    def contrast(self, scan: Tensor, pose: FloatArray) -> float:
        """Highest score on the map less the highest near a pose (3,): within some 10 m and 10 degrees.

        Coarse scores say where to look closely: at the best few places of the map, and at the best one near the pose.
        """
        lattice, vote = self.lattice, self._contrast
        with torch.inference_mode():
            scores = vote.scores(scan) / np.float32(self._temperature)
            centres = self._best_places(scores, self.settings.contrast_places)
            about = _near(pose, vote.grid, vote.bins)
            if all(len(axis) for axis in about):
                row, col, turn = np.unravel_index(np.argmax(scores[np.ix_(*about)]), [len(axis) for axis in about])
                centres = np.concatenate([centres, [[about[0][row], about[1][col], about[2][turn]]]])
            xy = vote.grid.xy_from_pixel(centres[:, :2] + 0.5)
            places = np.concatenate([np.column_stack([xy, centres[:, 2] * (se2.TWO_PI / vote.bins)]), pose[None]])
            cut, fine = self._closely(scan, np.unique(self._cells_of(places), axis=0))
        highest = fine.max(axis=(1, 2, 3))
        about = _near(pose, lattice.coarse, self._yaw_bins // lattice.turn)
        is_near = np.all([np.isin(cut[:, axis], about[axis]) for axis in range(3)], axis=0)
        return float(highest.max() - highest.max(where=is_near, initial=fine.min()))

    def _coarse_scores(self, scan: Tensor) -> Float32Array:
        """(rows, cols, K) on the coarse cells."""
        grid = self.lattice.coarse
        result = self._coarse.scores(scan)[1 : grid.rows + 1, 1 : grid.cols + 1]
        if self._prior is not None:
            result += self._prior.mean(axis=(1, 3))[:, :, None]
        return result / np.float32(self._temperature)

    def _best_places(self, coarse: Float32Array, most: int) -> IntArray:
        """Row, column and bin (M, 3) of the highest local maxima, so many at most."""
        scores = torch.from_numpy(coarse).permute(2, 0, 1)[None]
        around = torch.cat([scores[:, -1:], scores, scores[:, :1]], dim=1)[None]
        highest = functional.max_pool3d(around, 3, stride=1, padding=(0, 1, 1))[0, 0]
        flat = scores[0]
        best = float(flat.max())
        peaks = torch.nonzero((flat == highest) & (flat >= best - self.settings.range_nats))
        values = flat[tuple(peaks.T)]
        chosen = peaks[torch.argsort(values, descending=True, stable=True)[:most]]
        return chosen[:, [1, 2, 0]].numpy().astype(np.int64)

    def _cells_of(self, poses: FloatArray) -> IntArray:
        """Coarse cells (M, 3) of poses (N, 3); those off the map are left out."""
        grid, bins = self.lattice.coarse, self._yaw_bins // self.lattice.turn
        row_col = np.floor(grid.pixel_from_xy(poses[:, :2])).astype(np.int64)
        yaw = np.rint(poses[:, 2] * bins / se2.TWO_PI).astype(np.int64) % bins
        inside = ((row_col >= 0) & (row_col < [grid.rows, grid.cols])).all(axis=1)
        return np.column_stack([row_col, yaw])[inside]

    def _closely(self, scan: Tensor, centres: IntArray) -> tuple[IntArray, Float32Array]:
        """The cells (M, 3) at and beside `centres`, and the scores (M, side, side, turn) of their fine cells."""
        lattice, grid = self.lattice, self.lattice.coarse
        side, turn, bins = lattice.side, lattice.turn, self._yaw_bins // self.lattice.turn
        templates = _TurnedTemplates(scan, self._yaw_bins, fast_length(lattice.template - 1 + 3 * side))
        known: dict[tuple[int, int, int], Float32Array] = {}
        for at_row, at_col, at_bin in centres.tolist():
            rows = range(max(at_row - 1, 0), min(at_row + 2, grid.rows))
            cols = range(max(at_col - 1, 0), min(at_col + 2, grid.cols))
            yaws = [(at_bin + step) % bins for step in (-1, 0, 1)]
            block = self._fine_scores(templates, rows, cols, yaws)
            for i, row in enumerate(rows):
                for j, col in enumerate(cols):
                    for k, yaw in enumerate(yaws):
                        cell = block[i * side : (i + 1) * side, j * side : (j + 1) * side, k * turn : (k + 1) * turn]
                        known[row, col, yaw] = cell
        cells = sorted(known)
        return np.array(cells, np.int64), np.stack([known[cell] for cell in cells])

    def _fine_scores(self, templates: _TurnedTemplates, rows: range, cols: range, yaws: list[int]) -> Float32Array:
        """Scores (rows * side, cols * side, yaws * turn) of the fine cells of a box of coarse ones."""
        lattice = self.lattice
        side, turn, size = lattice.side, lattice.turn, lattice.template
        top, left = (lattice.first + side * cells.start for cells in (rows, cols))
        high, wide = (size - 1 + side * len(cells) for cells in (rows, cols))
        correlator = MapCorrelator(self._features[:, top : top + high, left : left + wide], templates.side)
        fine_bins = [yaw * turn + part - turn // 2 for yaw in yaws for part in range(turn)]
        found = [correlator.scores_of(*templates.spectrum(fine_bin % self._yaw_bins)) for fine_bin in fine_bins]
        scores = torch.stack(found, dim=-1).numpy()
        if self._prior is not None:
            box = self._prior[rows.start : rows.stop, :, cols.start : cols.stop, :]
            scores = scores + box.reshape(side * len(rows), side * len(cols))[:, :, None]
        return np.asarray(scores / np.float32(self._temperature), np.float32)

    def _prior_of_cells(self, prior: Tensor) -> Float32Array:
        """(rows, side, cols, side): the prior at the positions of the fine cells."""
        lattice, grid = self.lattice, self.lattice.coarse
        at = prior_scores(prior, lattice.template).numpy()
        first, side = lattice.first, lattice.side
        used = at[first : first + side * grid.rows, first : first + side * grid.cols]
        return used.reshape(grid.rows, side, grid.cols, side).astype(np.float32)


class _TurnedTemplates:
    """Spectra of a scan's features (C, n, n) at the headings of yaw bins, each made when it is first asked for."""

    def __init__(self, scan: Tensor, yaw_bins: int, side: int) -> None:
        self._scan, self._step, self.side = scan, 2 * math.pi / yaw_bins, side
        self._quarter = yaw_bins // 4 if yaw_bins % 4 == 0 else yaw_bins
        self._known: dict[int, Tensor] = {}

    def spectrum(self, yaw_bin: int) -> tuple[Tensor, int, int]:
        """What `MapCorrelator.scores_of` takes: a spectrum, the template's size and its quarter turns."""
        turns, base = divmod(yaw_bin, self._quarter)
        if base not in self._known:
            turned = rotate_templates(self._scan, torch.tensor([base * self._step], dtype=torch.float64))[0]
            self._known[base] = template_spectrum(turned, self.side)
        return self._known[base], self._scan.shape[-1], turns


def _near(pose: FloatArray, grid: MapGrid, bins: int) -> tuple[IntArray, IntArray, IntArray]:
    """Rows, columns and yaw bins of the cells of a grid within some 10 m and 10 degrees of a pose (3,)."""
    reach, half_turn = round(_NEAR_M / grid.metres_per_pixel), round(_NEAR_RAD * bins / se2.TWO_PI)
    row, col = (math.floor(at) for at in grid.pixel_from_xy(pose[:2]))
    turn = round(float(pose[2]) * bins / se2.TWO_PI)
    return (
        np.arange(max(row - reach, 0), min(row + reach + 1, grid.rows)),
        np.arange(max(col - reach, 0), min(col + reach + 1, grid.cols)),
        np.arange(turn - half_turn, turn + half_turn + 1) % bins,
    )


def _log_mean(values: Float32Array) -> Float32Array:
    """ln of the mean exponential of each cell's (M, side, side, turn)."""
    peak = values.max(axis=(1, 2, 3))
    mean = np.exp(values - peak[:, None, None, None]).mean(axis=(1, 2, 3), dtype=np.float64)
    return np.asarray(peak + np.log(mean), np.float32)


def _odd(number: float) -> int:
    """The odd number nearest to a positive one."""
    return max(2 * math.floor(number / 2) + 1, 1)


def _bins_together(yaw_bins: int, heading_deg: float) -> int:
    """The odd divisor of a number of yaw bins that makes coarse bins nearest to so many degrees."""
    odd = [number for number in range(1, yaw_bins + 1, 2) if yaw_bins % number == 0]
    return min(odd, key=lambda number: abs(math.log(number * 360.0 / yaw_bins / heading_deg)))
