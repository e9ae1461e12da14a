"""Training of place embeddings: a scan nearer to its own place on the map than to all others of the batch.

The network whose features they are stays as it is, so that harmonics are made once and the training itself takes
minutes. The logit of a scan and a place is ln sum_a exp(tau score(a)) over headings a, so that no heading has to be
known; the pair's own is tau score(true heading). The loss is symmetric InfoNCE (see `learned.contrastive`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from learned.bev import log_density
from learned.map_raster import PALETTE
from learned.network import picture_tensor
from learned.place_embedding import PlaceEmbedding, order_factors
from learned.retrieval import fingerprint_of
from learned.ring_harmonics import RingHarmonics, at_headings
from learned.rotmatch import RotMatchNet
from learned.samples import Sample

_SAME_PLACE_M = 20.0
_MARGIN_PX = 32
"""Of the map beyond the scan's reach that the encoder is shown."""
_HEADINGS = 48


@dataclass(frozen=True, slots=True)
class PlaceTraining:
    """How to train: embedding size D a ring order, steps, batch, rate; the seed decides on batches and dropout."""

    size: int = 16
    steps: int = 90
    batch: int = 256
    learning_rate: float = 3e-3
    feature_dropout: float = 0.1
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class PlacePairs:
    """Harmonics (S, F, M + 1) of scans and of the map near them, true yaws (S,), and where it was (S, 2), metres."""

    scans: Tensor
    places: Tensor
    yaws: Tensor
    positions: Tensor


def pairs_of(net: RotMatchNet, samples: Iterable[tuple[Sample, FloatArray]], harmonics: RingHarmonics) -> PlacePairs:
    """Harmonics of samples whose scans reach as far as the rings do.

    Parameters
    ----------
    samples
        Each with how far its place lies from where it was taken, (2,) metres along rows and columns of its map.

    Raises
    ------
    SkyfixError
        If there are fewer than two samples.
    """
    net = net.reaching(harmonics.reach_m).eval()
    basis, rows, yaws, positions = harmonics.basis(), [], [], []
    with torch.inference_mode():
        for sample, offset_m in samples:
            rows.append(_pair(net, sample, harmonics, basis, offset_m))
            yaws.append(sample.yaw)
            positions.append(sample.place)
    if len(rows) < 2:
        raise SkyfixError(f"place training: expected two samples or more, got {len(rows)}")
    scans, places = (torch.stack(column).clone() for column in zip(*rows, strict=True))
    return PlacePairs(scans, places, torch.tensor(yaws), torch.tensor(positions, dtype=torch.float64))


def _pair(
    net: RotMatchNet, sample: Sample, harmonics: RingHarmonics, basis: Tensor, offset_m: FloatArray
) -> tuple[Tensor, Tensor]:
    cell_m, stride = net.stride * net.bev.metres_per_pixel, net.stride
    pool, half = round(harmonics.cell_m / cell_m), round(harmonics.reach_m / cell_m)
    density = torch.from_numpy(log_density(sample.counts.astype(np.float32)))[None].float()
    at, size = np.array([sample.row, sample.col]), len(sample.classes)
    side = min(2 * half * stride + 2 * _MARGIN_PX, size)
    top, left = np.clip(stride * np.rint((at - side / 2) / stride).astype(int), 0, size - side)
    crop = sample.classes[top : top + side, left : left + side]
    found = net.map_features(picture_tensor(PALETTE[crop])[None])
    corner = np.rint((at - [top, left]) / stride + offset_m / cell_m).astype(int) - half
    row, col = np.clip(corner, 0, side // stride - 2 * half)
    images = torch.cat([net.scan_features(density), found[:, :, row : row + 2 * half, col : col + 2 * half]])
    both = harmonics.of(torch.nn.functional.avg_pool2d(images, pool), basis)
    return both[0], both[1]


def train_places(
    net: RotMatchNet, pairs: PlacePairs, harmonics: RingHarmonics, settings: PlaceTraining
) -> PlaceEmbedding:
    """Train projections on pairs."""
    scan_mean, place_mean = (each[:, :, 0].real.mean(0) for each in (pairs.scans, pairs.places))
    scans, scan_scale = _scaled(pairs.scans, scan_mean)
    places, place_scale = _scaled(pairs.places, place_mean)
    start = _principal(places, scan_scale * place_scale, settings.size)
    weights = [torch.view_as_real(start).clone().requires_grad_() for _ in range(2)]
    log_tau = torch.tensor(math.log(20.0), requires_grad=True)
    optimizer = torch.optim.AdamW([{"params": weights}, {"params": [log_tau]}], weight_decay=1e-3)
    for step, chosen in enumerate(_batches(len(scans), settings)):
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + step)
        kept = (torch.rand(1, scans.shape[1], 1, generator=generator) > settings.feature_dropout).float()
        one, other = (
            _embedded(each, torch.view_as_complex(w))
            for each, w in zip((scans[chosen] * kept, places[chosen]), weights, strict=True)
        )
        loss = _loss(one, other, log_tau.exp(), pairs.yaws[chosen], pairs.positions[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    scan_weights, map_weights = (
        torch.view_as_complex(w.detach()) / scale.T[:, :, None]
        for w, scale in zip(weights, (scan_scale, place_scale), strict=True)
    )
    return PlaceEmbedding(scan_weights, map_weights, scan_mean, place_mean, fingerprint_of(net), harmonics)


def _scaled(harmonics: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Harmonics of unit variance, order 0 of mean zero, and what they were divided by (F, M + 1)."""
    centred = harmonics.clone()
    centred[:, :, 0] -= mean
    scale = centred.abs().square().mean(0).sqrt() + 1e-4
    return centred / scale, scale


def _principal(places: Tensor, worth: Tensor, size: int) -> Tensor:
    """(M + 1, F, size): the principal directions of what places add to a vote, where training starts."""
    found = []
    for order in range(places.shape[2]):
        root = worth[:, order].sqrt()
        directions = torch.linalg.svd(places[:, :, order] * root, full_matrices=False)[2][:size]
        found.append(directions.conj().T * root[:, None])
    return torch.stack(found)


def _batches(count: int, settings: PlaceTraining) -> Iterator[Tensor]:
    for step in range(settings.steps):
        rng = np.random.default_rng((settings.seed, step))
        yield torch.from_numpy(rng.choice(count, min(settings.batch, count), replace=False))


def _embedded(harmonics: Tensor, weights: Tensor) -> Tensor:
    found = torch.einsum("nfm,mfd->nmd", harmonics, weights)
    return found / (found.abs().square().sum(-1) @ order_factors(found.shape[1])).sqrt()[:, None, None]


def _loss(scans: Tensor, places: Tensor, tau: Tensor, yaws: Tensor, positions: Tensor) -> Tensor:
    products = torch.einsum("imd,jmd->ijm", scans.conj(), places) * order_factors(scans.shape[1]) * tau
    logits = torch.logsumexp(at_headings(products, _HEADINGS), -1)
    near = (positions[:, None] - positions[None]).norm(dim=-1) < _SAME_PLACE_M
    logits = logits.masked_fill(near & ~torch.eye(len(scans), dtype=torch.bool), -torch.inf)
    turned = torch.exp(1j * torch.arange(scans.shape[1]) * yaws[:, None])
    own = (products.diagonal().T * turned).real.sum(-1).float()
    return 0.5 * ((torch.logsumexp(logits, 1) - own).mean() + (torch.logsumexp(logits, 0) - own).mean())
