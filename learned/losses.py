"""The likelihood of the truth under a voted volume, as a loss.

The normaliser of the volume is an integral over position and heading. Positions are summed exactly; headings by a
quadrature that is fine about the truth, where the density is sharp, and coarse with a random phase elsewhere, where
it is enough to find false modes. Each heading counts with the width of the circle that it stands for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class HeadingQuadrature:
    """Headings scored in training: `fine` ones `fine_step_deg` apart about the truth, `coarse` ones on the rest."""

    fine: int = 9
    fine_step_deg: float = 1.5
    coarse: int = 12

    def draw(self, yaw: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Yaws (R,) and widths (R,), radians; the fine ones come first and the truth lies between two of them."""
        phase_fine, phase_coarse = torch.rand(2, generator=generator).tolist()
        step = math.radians(self.fine_step_deg)
        fine = yaw + (torch.arange(self.fine) - (self.fine // 2) + phase_fine - 0.5) * step
        rest = 2 * math.pi - self.fine * step
        wide = rest / self.coarse
        coarse = fine[-1] + step / 2 + (torch.arange(self.coarse) + phase_coarse) * wide
        widths = torch.cat([torch.full((self.fine,), step), torch.full((self.coarse,), wide)])
        return torch.cat([fine, coarse]), widths


def scores_nll(
    scores: Tensor,
    truth: tuple[float, float, float],
    yaws: Tensor,
    widths: Tensor,
    metres_per_cell: float,
    quadrature: HeadingQuadrature,
) -> Tensor:
    """Negative log density (per m^2 rad) of the true pose under the softmax of scores.

    Parameters
    ----------
    scores
        (R, rows, cols) unnormalised log densities at the headings `yaws`.
    truth
        Row and column in the lattice of the scores, whose integers are the samples, and yaw (radians).
    yaws, widths
        (R,) what `quadrature` drew; the fine headings alone (the first `quadrature.fine`) will do.
    metres_per_cell
        Spacing of the lattice.
    """
    row, col, yaw = truth
    log_cell = torch.log(widths) + 2 * math.log(metres_per_cell)
    normaliser = torch.logsumexp(scores.flatten(1) + log_cell[:, None], dim=(0, 1))
    below, above = _neighbours(yaws, yaw, quadrature.fine)
    weight = float((yaw - yaws[below]) / math.radians(quadrature.fine_step_deg))
    at_yaw = torch.lerp(_bilinear(scores[below], row, col), _bilinear(scores[above], row, col), weight)
    return normaliser - at_yaw


def _neighbours(yaws: Tensor, yaw: float, fine: int) -> tuple[int, int]:
    """Indices of the two fine headings around the truth."""
    below = int((yaws[:fine] <= yaw).sum()) - 1
    below = min(max(below, 0), fine - 2)
    return below, below + 1


def _bilinear(image: Tensor, row: float, col: float) -> Tensor:
    """Value at continuous coordinates whose integers are the samples of the image, clamped to it."""
    row = min(max(row, 0.0), image.shape[0] - 1.000001)
    col = min(max(col, 0.0), image.shape[1] - 1.000001)
    top, left = int(row), int(col)
    upper = torch.lerp(image[top, left], image[top, left + 1], col - left)
    lower = torch.lerp(image[top + 1, left], image[top + 1, left + 1], col - left)
    return torch.lerp(upper, lower, row - top)
