"""Training place embeddings: pairs hidden in noise are told apart, turns of the scan do not matter, seeds decide."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from fusion.errors import SkyfixError
from learned.bev import BANDS_M, BevSettings
from learned.place_embedding import PlaceEmbedding, similarities
from learned.place_training import PlacePairs, PlaceTraining, pairs_of, train_places
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatchNet, RotMatchSettings
from learned.samples import Sample

RINGS = RingHarmonics((4.0, 8.0, 12.0), orders=4, cell_m=2.0, reach_m=20.0)
FEATURES = 12
SETTINGS = PlaceTraining(size=6, steps=50, batch=32, learning_rate=0.05)


def made_pairs(count: int, seed: int) -> PlacePairs:
    """Half of the features agree after a turn, with noise; the others are strong and mean nothing."""
    generator = torch.Generator().manual_seed(seed)

    def noise() -> Tensor:
        return torch.randn(count, FEATURES, RINGS.orders + 1, generator=generator, dtype=torch.complex64)

    yaws = torch.rand(count, generator=generator) * 6.0 - 3.0
    shared, strength = noise(), torch.cat([torch.ones(FEATURES // 2), torch.zeros(FEATURES // 2)])[:, None]
    phase = torch.exp(1j * torch.arange(RINGS.orders + 1) * yaws[:, None])[:, None]
    places = shared * strength + 0.2 * noise() + 3.0 * noise() * (1 - strength)
    scans = shared * strength * phase + 0.2 * noise() + 3.0 * noise() * (1 - strength)
    return PlacePairs(scans, places, yaws, torch.arange(count)[:, None] * torch.tensor([1e3, 0.0]))


def recall(embedding: PlaceEmbedding, pairs: PlacePairs) -> float:
    scans, places = embedding.of_scans(pairs.scans), embedding.of_places(pairs.places)
    best = torch.stack([similarities(scan, places, 72).amax(dim=1) for scan in scans])
    return float((best.argmax(dim=1) == torch.arange(len(scans))).float().mean())


@pytest.fixture(scope="module")
def net() -> RotMatchNet:
    torch.manual_seed(0)
    return RotMatchNet(RotMatchSettings(4, (4, 4, 8, 8), BevSettings(20.0)))


def test_it_learns_what_agrees(net: RotMatchNet) -> None:
    """On 60 pairs that it has not seen: guessing is right once, and nine times with a chance of less than 1e-5."""
    pairs, unseen = made_pairs(120, 0), made_pairs(60, 1)
    trained = train_places(net, pairs, RINGS, SETTINGS)
    untrained = train_places(net, pairs, RINGS, PlaceTraining(size=6, steps=0))
    assert recall(untrained, unseen) < 0.1
    assert recall(trained, unseen) >= 9 / 60
    again = train_places(net, pairs, RINGS, SETTINGS)
    torch.testing.assert_close(again.scan_weights, trained.scan_weights, rtol=0, atol=0)
    together = train_places(net, replace(pairs, positions=pairs.positions * 0.0), RINGS, SETTINGS)
    assert recall(together, unseen) < 0.12  # scans of one place are not contrasted: nothing to learn
    kept = train_places(net, pairs, RINGS, replace(SETTINGS, feature_dropout=0.0))
    assert not torch.allclose(kept.scan_weights, trained.scan_weights, rtol=0.1)


def test_pairs_are_made_of_samples(net: RotMatchNet) -> None:
    rng = np.random.default_rng(0)
    samples = [
        Sample(
            rng.integers(0, 4, (len(BANDS_M), 80, 80)).astype(np.uint8),
            rng.integers(0, 5, (128, 128)).astype(np.uint8),
            62.0,
            66.0,
            0.3,
            (float(number), 0.0),
        )
        for number in range(3)
    ]
    placed = [(sample, np.array([1.0, -2.0])) for sample in samples]
    pairs = pairs_of(net, placed, RINGS)
    assert pairs.scans.shape == pairs.places.shape == (3, 4 * 3, 5)
    torch.testing.assert_close(pairs_of(net, placed, RINGS).places, pairs.places, rtol=0, atol=0)
    there = pairs_of(net, [(sample, np.zeros(2)) for sample in samples], RINGS)
    torch.testing.assert_close(there.scans, pairs.scans, rtol=0, atol=0)
    assert not torch.allclose(there.places, pairs.places, rtol=0.1)  # the map is seen from where the offset leads
    with pytest.raises(SkyfixError, match="place training: expected two samples or more, got 1"):
        pairs_of(net, placed[:1], RINGS)
