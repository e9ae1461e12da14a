"""Contrastive learning of scan and map: the true pair closer than any other of the batch.

Symmetric InfoNCE (van den Oord et al., 2018, equation 4; CLIP's form) with temperature 0.07 over the hardest
negatives, after TransLocNet (arXiv 2512.10419). It must be fed features from before the cross-attention: after it,
each side has seen the other and the pair gives itself away. Two samples that are less than 20 m apart show the same
place and are no negatives of each other. Where several processes share a batch, the negatives are of all of it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fusion.errors import SkyfixError
from learned.processes import rows_of_all


class Projection(nn.Module):
    """Pooled features (B, C) -> unit vectors (B, outputs)."""

    def __init__(self, channels: int, outputs: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(channels, channels, bias=False),
            nn.LayerNorm(channels),
            nn.ReLU(inplace=True),
            nn.Linear(channels, outputs, bias=False),
        )

    def forward(self, pooled: Tensor) -> Tensor:
        """Project and normalise."""
        return nn.functional.normalize(self.mlp(pooled), dim=-1)


def info_nce(
    scans: Tensor,
    maps: Tensor,
    temperature: float = 0.07,
    hard_negatives: int | None = None,
    positions_m: Tensor | None = None,
    same_place_m: float = 20.0,
) -> Tensor:
    """Mean of the losses of finding each scan's map and each map's scan.

    Parameters
    ----------
    scans, maps
        (B, D) unit vectors; row i of both is one place. Of processes that train together each gives its share.
    temperature
        tau, divides the cosines.
    hard_negatives
        k: only the k most similar negatives of each anchor count; all of them when None.
    positions_m
        (B, 2) where the samples were taken, metres; NaN where that is not known. All are far apart when None.
    same_place_m
        Pairs nearer than this are not negatives.

    Returns
    -------
    A scalar; 0 for anchors without a negative.

    Raises
    ------
    SkyfixError
        If the shapes disagree.
    """
    if scans.ndim != 2 or scans.shape != maps.shape:
        raise SkyfixError(f"embeddings: expected two of (B, D), got {tuple(scans.shape)} and {tuple(maps.shape)}")
    scans, maps = rows_of_all(scans), rows_of_all(maps)
    positions_m = None if positions_m is None else rows_of_all(positions_m)
    logits = scans @ maps.T / temperature
    negative = negatives(len(scans), positions_m, same_place_m).to(logits.device)
    both = (_one_way(logits, negative, hard_negatives), _one_way(logits.T, negative, hard_negatives))
    return 0.5 * (both[0] + both[1])


def negatives(count: int, positions_m: Tensor | None, same_place_m: float) -> Tensor:
    """Which pairs (count, count) are of different places.

    Raises
    ------
    SkyfixError
        If positions are given and not (count, 2).
    """
    different = ~torch.eye(count, dtype=torch.bool)
    if positions_m is None:
        return different
    if positions_m.shape != (count, 2):
        raise SkyfixError(f"positions: expected ({count}, 2), got {tuple(positions_m.shape)}")
    apart = torch.linalg.vector_norm(positions_m[:, None] - positions_m[None, :], dim=-1).cpu()
    return different & ~(apart < same_place_m)  # an unknown distance (NaN) is a large one


def _one_way(logits: Tensor, negative: Tensor, hard_negatives: int | None) -> Tensor:
    """Cross-entropy of the diagonal against each row's hardest negatives."""
    others = logits.masked_fill(~negative, -torch.inf)
    if hard_negatives is not None:
        others = others.topk(min(hard_negatives, len(logits)), dim=1).values
    positive = logits.diagonal()
    return (torch.logsumexp(torch.cat([positive[:, None], others], dim=1), dim=1) - positive).mean()
