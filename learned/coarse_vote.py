"""A vote on coarse cells: both feature images averaged over blocks of cells, the scan's over a step of heading too.

The score of a coarse cell is a mean of the fine scores about it, so that no peak falls between the cells, however
sharp; but all peaks are lowered, the sharp ones most.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from fusion.arrays import Float32Array
from fusion.grid import MapGrid
from learned.correlation import MapCorrelator
from learned.voting import quarter_turn_groups, rotate_templates

_SUB_HEADINGS = 3


class CoarseVote:
    """A map's features, averaged and ready to be correlated with scans.

    Parameters
    ----------
    features
        (C, H, W) of the map.
    window
        Where their cells lie.
    template
        Cells of a scan's features on a side, even.
    side
        Cells of a block, odd.
    bins
        Headings on the circle.
    """

    def __init__(self, features: Tensor, window: MapGrid, template: int, side: int, bins: int) -> None:
        self._side, self.bins = side, bins
        padded = padded_size(template, side)
        self._margin = (padded - template) // 2
        self._correlator = MapCorrelator(functional.avg_pool2d(features[None], side)[0])
        rows, cols = (extent // side - padded // side + 1 for extent in (window.rows, window.cols))
        feature_m, inset = window.metres_per_pixel, 0.5 * (padded - side) * window.metres_per_pixel
        top = window.y0 + window.height_m - inset
        cell = side * feature_m
        self.grid = MapGrid(rows, cols, cell, window.x0 + inset, top - rows * cell)

    def scores(self, scan: Tensor) -> Float32Array:
        """(rows, cols, bins) on `grid`, of a scan's features (C, n, n)."""
        step = 2 * math.pi / self.bins
        spread = (torch.arange(_SUB_HEADINGS, dtype=torch.float64) - _SUB_HEADINGS // 2) / _SUB_HEADINGS * step
        result = np.empty((self.grid.rows, self.grid.cols, self.bins), np.float32)
        for yaw, members in quarter_turn_groups(torch.arange(self.bins, dtype=torch.float64) * step):
            turned = functional.pad(rotate_templates(scan, yaw + spread).mean(dim=0), [self._margin] * 4)
            template = functional.avg_pool2d(turned[None], self._side)[0] * self._side**2
            found = self._correlator.scores(template, [turns for _, turns in members])
            for (index, _), scores in zip(members, found, strict=True):
                result[:, :, index] = scores.numpy()
        return result


def padded_size(template: int, side: int) -> int:
    """Cells on a side of a template that is padded to an even number of blocks."""
    return 2 * side * math.ceil(template / (2 * side))
