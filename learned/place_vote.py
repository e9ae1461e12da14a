"""The vote of a scan's features at a few places of a map, all headings: `learned.voting`'s score without its FFTs.

A whole map is best voted on by FFTs. A few hundred places of it are far apart; there the windows of the map's
features are cut out, and one product with the scan's features, turned to every heading, scores them all. The cost does
not depend on the map's size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from learned.voting import rotate_templates

_AT_ONCE = 16


class BestVotes(NamedTuple):
    """Of each of some squares the best vote (N,), the vehicle's row and column (N, 2), and which heading it was."""

    votes: Float32Array
    corners: IntArray
    headings: IntArray


def vote_at(features: Tensor, scan: Tensor, corners: IntArray, span: int, headings: int) -> Float32Array:
    """Highest vote (N, headings) in each of some squares of a map; that of yaw 2 pi j / headings is in column j.

    Parameters
    ----------
    features
        (C, H, W) of the map; zero outside.
    scan
        (C, n, n), n even, on cells of the same size, the vehicle on the corner of the four middle ones.
    corners
        (N, 2) row and column of the squares' upper left cell.
    span
        Their side in cells: the vehicle is tried on the upper left corner of each of the span^2 cells.

    Raises
    ------
    SkyfixError
        If the channels differ, or the scan is not a square of an even number of cells.
    """
    half = _half_of(features, scan)
    yaws = torch.arange(headings, dtype=torch.float64) * (se2.TWO_PI / headings)
    templates = rotate_templates(scan, yaws).reshape(headings, -1).T
    padded = functional.pad(features, (half, half + span, half, half + span))
    found = np.empty((len(corners), headings), np.float32)
    for start in range(0, len(corners), _AT_ONCE):
        block = corners[start : start + _AT_ONCE].tolist()
        side = 2 * half + span - 1
        squares = torch.stack([padded[:, row : row + side, col : col + side].float() for row, col in block])
        windows = squares.unfold(2, 2 * half, 1).unfold(3, 2 * half, 1).permute(0, 2, 3, 1, 4, 5)
        votes = windows.reshape(len(block) * span**2, -1) @ templates
        found[start : start + len(block)] = votes.view(len(block), span**2, headings).amax(dim=1).numpy()
    return found


def best_votes(features: Tensor, scan: Tensor, corners: IntArray, span: int, yaws: FloatArray) -> BestVotes:
    """The best vote in each of some squares of a map, at a few headings of its own.

    Parameters
    ----------
    features, scan, corners, span
        As in `vote_at`.
    yaws
        (N, R) headings, radians.

    Raises
    ------
    SkyfixError
        As `vote_at`.
    """
    half = _half_of(features, scan)
    padded = functional.pad(features, (half, half + span, half, half + span))
    side, at = 2 * half + span - 1, np.empty(len(corners), np.int64)
    votes = np.empty(len(corners), np.float32)
    for number, (row, col) in enumerate(corners.tolist()):
        templates = rotate_templates(scan, torch.from_numpy(yaws[number]))
        square = padded[None, :, row : row + side, col : col + side].float()
        found = functional.conv2d(square, templates)[0].flatten()
        at[number] = int(found.argmax())
        votes[number] = float(found[at[number]])
    heading, row, col = np.unravel_index(at, (yaws.shape[1], span, span))
    return BestVotes(votes, corners + np.column_stack([row, col]), heading)


def _half_of(features: Tensor, scan: Tensor) -> int:
    """Half the side of a scan's features, in cells."""
    if scan.ndim != 3 or scan.shape[0] != features.shape[0] or scan.shape[1] != scan.shape[2] or scan.shape[1] % 2:
        raise SkyfixError(f"scan features: expected ({features.shape[0]}, n, n), n even, got {tuple(scan.shape)}")
    return scan.shape[-1] // 2
