"""Refining a coarse vote by a finer one about its best poses, so that the two are one density in the end.

Inside a window about a coarse mode the finer scores say how the window's mass is spread; how much mass the window has
remains for the coarse ones to say:  p(pose) = P_coarse(window) p_fine(pose | window). So the whole stays normalised,
and a pose that no window covers keeps its coarse density.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from learned.losses import HeadingQuadrature


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """Where the finer stage looks.

    Attributes
    ----------
    half_extent_m, half_heading_deg
        A window reaches this far about a coarse mode.
    modes
        Number of coarse modes that get a window.
    """

    half_extent_m: float = 8.0
    half_heading_deg: float = 20.0
    modes: int = 3


@dataclass(frozen=True, slots=True)
class Window:
    """A box of the lattice of scores: heading indices, and half-open ranges of rows and columns."""

    headings: Tensor
    rows: slice
    cols: slice


def window_about(row: float, col: float, half_cells: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns within `half_cells` of a place, cut to a lattice of a shape; never empty."""
    centres = (min(max(round(place), 0), size - 1) for place, size in zip((row, col), shape, strict=True))
    rows, cols = (
        slice(max(centre - half_cells, 0), min(centre + half_cells + 1, size))
        for centre, size in zip(centres, shape, strict=True)
    )
    return rows, cols


def refined(
    coarse: Tensor,
    yaws: Tensor,
    log_widths: Tensor,
    half_cells: int,
    settings: RefinementSettings,
    fine_scores: Callable[[Window], Tensor],
) -> Tensor:
    """Scores (R, rows, cols) with the finer ones in the windows about the coarse modes.

    Parameters
    ----------
    coarse
        (R, rows, cols) unnormalised log densities on the fine lattice.
    yaws, log_widths
        (R,) headings, and the log of how much of the circle each stands for, up to a constant.
    half_cells
        Half a window's extent, cells of the lattice.
    fine_scores
        Gives the finer scores of a window, (headings, rows, cols), unnormalised.
    """
    result = coarse.clone()
    free = torch.ones_like(coarse, dtype=torch.bool)
    for _ in range(settings.modes):
        if not bool(free.any()):
            break
        best = int(torch.where(free, coarse, -torch.inf).argmax())
        heading, cell = divmod(best, coarse[0].numel())
        rows, cols = window_about(*divmod(cell, coarse.shape[2]), half_cells, (coarse.shape[1], coarse.shape[2]))
        away = torch.remainder(yaws - yaws[heading] + math.pi, 2 * math.pi) - math.pi
        headings = torch.nonzero(away.abs() <= math.radians(settings.half_heading_deg) + 1e-6)[:, 0]
        inside = (headings[:, None, None], _axis(rows, 1, coarse.device), _axis(cols, 2, coarse.device))
        new, fine = free[inside], fine_scores(Window(headings, rows, cols))
        width = log_widths[headings][:, None, None]
        mass, fine_mass = (torch.logsumexp((scores + width)[new], dim=0) for scores in (coarse[inside], fine))
        result[inside] = torch.where(new, fine + (mass - fine_mass), result[inside])
        free[inside] = False
    return result


def _axis(cells: slice, dimension: int, device: torch.device) -> Tensor:
    shape = [1, 1, 1]
    shape[dimension] = -1
    return torch.arange(cells.start, cells.stop, device=device).view(shape)


def headings_within(
    quadrature: HeadingQuadrature, yaw: float, half_range_rad: float, generator: torch.Generator, wide: int = 4
) -> tuple[Tensor, Tensor]:
    """Yaws and widths of a range about the truth: the quadrature's fine ones and a few `wide` ones for the rest."""
    yaws, widths = (drawn[: quadrature.fine] for drawn in quadrature.draw(yaw, generator))
    step = math.radians(quadrature.fine_step_deg)
    width = max(2 * half_range_rad - quadrature.fine * step, 0.0) / wide
    if width == 0.0:
        return yaws, widths
    others = yaws[-1] + step / 2 + (torch.arange(wide) + torch.rand(1, generator=generator)) * width
    others = torch.where(others > yaw + half_range_rad, others - 2 * half_range_rad, others)
    return torch.cat([yaws, others]), torch.cat([widths, torch.full((wide,), width)])
