"""The skeleton of a scene: where something stands, thinned, whatever it looks like from above or from the ground.

AGL-Net (Guan et al., IROS 2024) matches skeleton features in its second stage and trains them with a skeleton loss.
Here a scan's own raised returns say where the skeleton is; seen from the true pose, the map's skeleton has to be
there too (binary cross-entropy, over the cells that the scan observed), and both skeletons have to agree, so that
the scan's leaves out what is on no map, such as parked cars.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from learned.bev import BODY, GROUND

_RETURNED = 0.15
"""A log density above this is at least one return."""
_RIDGE = 0.9
"""A cell belongs to the skeleton if it is at least this times the highest of the 3 x 3 cells around it."""


def skeleton_targets(density: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Skeleton (B, n, n) in {0, 1} of scans (B, bands, n stride, n stride), and which cells were observed.

    A cell is of the skeleton if its raised returns are a ridge: about as dense as the densest of its neighbours. It
    was observed if there is a return, of the ground or above it, in it or beside it.
    """
    raised = functional.max_pool2d(density[:, BODY:].amax(dim=1), stride)
    ground = functional.max_pool2d(density[:, GROUND], stride)
    ridge = functional.max_pool2d(raised, 3, stride=1, padding=1)
    skeleton = (raised > _RETURNED) & (raised >= _RIDGE * ridge)
    observed = functional.max_pool2d(torch.maximum(raised, ground), 3, stride=1, padding=1) > _RETURNED
    return skeleton.to(density.dtype), observed


def skeleton_loss(scan_logits: Tensor, map_logits: Tensor, skeleton: Tensor, observed: Tensor) -> Tensor:
    """Mean over observed cells of the map's cross-entropy and of the difference of the two skeletons.

    Parameters
    ----------
    scan_logits, map_logits
        (B, n, n) in the body frame, the map's seen from the true pose.
    skeleton, observed
        What `skeleton_targets` gave; cells that lie off the map should not count as observed.
    """
    entropy = functional.binary_cross_entropy_with_logits(map_logits, skeleton, reduction="none")
    difference = (torch.sigmoid(scan_logits) - torch.sigmoid(map_logits)).abs()
    return ((entropy + difference) * observed).sum() / observed.sum().clamp(min=1)
