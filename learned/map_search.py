"""Search of a whole map: every pose scored on coarse cells, and the best places again on the vote's own cells.

Around the best coarse cells, and around poses that somebody asks about, each is cut into the cells of the ordinary
vote, whose scores are those of a narrow search. A coarse score is a mean of log densities (`coarse_vote`) and so less
than the log of a mean: what the cut places gain by it, in the median, is granted to all the others.

The spectra of the map are worked out once, so the map's features should be handed over once for a drive. Source of the
two steps: Olson, "Real-time correlative scan matching", ICRA 2009, section V (many-to-one resolutions).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.two_level import TwoLevelLikelihood
from learned.coarse_vote import CoarseVote
from learned.correlation import MapCorrelator, fast_length, template_spectrum
from learned.map_lattice import MapLattice, MapSearchSettings, bins_together, odd_near
from learned.voting import prior_scores, rotate_templates


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
        side = odd_near(settings.contrast_cell_m / lattice.window.metres_per_pixel)
        bins = yaw_bins // bins_together(yaw_bins, settings.contrast_heading_deg)
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

    def contrast(self, scan: Tensor, pose: FloatArray, reach: FloatArray) -> float:
        """Highest score on the map less the highest within `reach` (3,) of a pose (3,): metres, metres, radians.

        Coarse scores say where to look closely: at the best few places of the map, at the best one near the pose, and
        at the pose.
        """
        vote = self._contrast
        with torch.inference_mode():
            scores = vote.scores(scan) / np.float32(self._temperature)
            centres = self._best_places(scores, self.settings.contrast_places)
            about = _near(pose, reach, vote.grid, vote.bins)
            if all(len(axis) for axis in about):
                row, col, turn = np.unravel_index(np.argmax(scores[np.ix_(*about)]), [len(axis) for axis in about])
                centres = np.concatenate([centres, [[about[0][row], about[1][col], about[2][turn]]]])
            xy = vote.grid.xy_from_pixel(centres[:, :2] + 0.5)
            places = np.concatenate([np.column_stack([xy, centres[:, 2] * (se2.TWO_PI / vote.bins)]), pose[None]])
            cut, fine = self._closely(scan, np.unique(self._cells_of(places), axis=0))
        offset = self._fine_poses(cut) - pose
        offset[..., 2] = se2.wrap(offset[..., 2])
        is_near = (np.abs(offset) <= reach).all(axis=-1)
        return float(fine.max() - fine.max(where=is_near, initial=fine.min()))

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

    def _fine_poses(self, cut: IntArray) -> FloatArray:
        """Poses (M, side, side, turn, 3) in the middle of the fine cells of coarse ones (M, 3)."""
        side, turn, grid = self.lattice.side, self.lattice.turn, self.lattice.coarse
        within = (np.arange(side) + 0.5) / side
        row, col = (cut[:, axis, None] + within for axis in (0, 1))
        yaw = (cut[:, 2, None] * turn + np.arange(turn) - turn // 2) * (se2.TWO_PI / self._yaw_bins)
        shape = (len(cut), side, side, turn)
        row, col, yaw = row[:, :, None, None], col[:, None, :, None], yaw[:, None, None, :]
        at = np.stack([np.broadcast_to(axis, shape) for axis in (row, col)], axis=-1)
        return np.concatenate([grid.xy_from_pixel(at), np.broadcast_to(yaw, shape)[..., None]], axis=-1)

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


def _near(pose: FloatArray, reach: FloatArray, grid: MapGrid, bins: int) -> tuple[IntArray, IntArray, IntArray]:
    """Rows, columns and yaw bins of the cells of a grid within reach (3,) of a pose (3,)."""
    across, down = (round(float(metres) / grid.metres_per_pixel) for metres in reach[:2])
    half_turn = round(float(reach[2]) * bins / se2.TWO_PI)
    row, col = (math.floor(at) for at in grid.pixel_from_xy(pose[:2]))
    turn = round(float(pose[2]) * bins / se2.TWO_PI)
    return (
        np.arange(max(row - down, 0), min(row + down + 1, grid.rows)),
        np.arange(max(col - across, 0), min(col + across + 1, grid.cols)),
        np.arange(turn - half_turn, turn + half_turn + 1) % bins,
    )


def _log_mean(values: Float32Array) -> Float32Array:
    """ln of the mean exponential of each cell's (M, side, side, turn)."""
    peak = values.max(axis=(1, 2, 3))
    mean = np.exp(values - peak[:, None, None, None]).mean(axis=(1, 2, 3), dtype=np.float64)
    return np.asarray(peak + np.log(mean), np.float32)
