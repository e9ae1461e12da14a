"""Samples, loss and training: geometry survives augmentation, resuming changes nothing, the loss is a density."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.errors import SkyfixError
from learned.losses import HeadingQuadrature, truth_nll
from learned.map_raster import CLASS_INDEX
from learned.rotmatch import RotMatchSettings
from learned.samples import Augmentation, Sample, augment
from learned.training import NetworkChoice, TrainingSettings, train

WALL = CLASS_INDEX["wall"]
PLAIN = Augmentation(drop_class=0.0, thin=0.0, shorten=0.0, drop_sector=0.0, drop_band=0.0)


def landmark_sample(seed: int) -> Sample:
    """Random wall blocks on a map, and the body-height returns that a vehicle among them would have."""
    rng = np.random.default_rng(seed)
    row, col, yaw = 168 + rng.uniform(-4, 4), 168 + rng.uniform(-4, 4), rng.uniform(-math.pi, math.pi)
    classes = np.zeros((336, 336), np.uint8)
    counts = np.zeros((4, 160, 160), np.uint8)
    for _ in range(40):
        ahead, left = rng.uniform(-74, 74, 2)
        top = row - (math.sin(yaw) * ahead + math.cos(yaw) * left)
        side = col + (math.cos(yaw) * ahead - math.sin(yaw) * left)
        classes[round(top) - 2 : round(top) + 2, round(side) - 2 : round(side) + 2] = WALL
        counts[1, round(80 - left) - 2 : round(80 - left) + 2, round(80 + ahead) - 2 : round(80 + ahead) + 2] = 30
    return Sample(counts, classes, row, col, yaw)


class Landmarks:
    """A sample source of landmark samples."""

    def __init__(self, count: int) -> None:
        self.samples = [landmark_sample(seed) for seed in range(count)]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        return self.samples[index]

    def order(self, rng: np.random.Generator) -> np.ndarray:
        return rng.permutation(len(self))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25)
def test_augmentation_moves_truth_scan_and_map_together(seed: int) -> None:
    example = augment(landmark_sample(seed % 7), np.random.default_rng(seed), PLAIN)
    rows, cols = np.nonzero(example.density[1])
    ahead, left = cols + 0.5 - 80, 80 - (rows + 0.5)
    top = example.row - (math.sin(example.yaw) * ahead + math.cos(example.yaw) * left)
    side = example.col + (math.cos(example.yaw) * ahead - math.sin(example.yaw) * left)
    seen = (top > 4) & (top < 252) & (side > 4) & (side < 252)
    walls = (example.picture == example.picture.max(axis=(0, 1))).all(axis=-1)
    near = np.array(
        [walls[int(t) - 3 : int(t) + 4, int(s) - 3 : int(s) + 4].any() for t, s in zip(top, side, strict=True)]
    )
    assert seen.sum() > 50
    assert near[seen].mean() > 0.99


def test_quadrature_covers_the_circle_once() -> None:
    quadrature = HeadingQuadrature()
    generator = torch.Generator().manual_seed(0)
    for yaw in (-3.0, 0.0, 2.5):
        yaws, widths = quadrature.draw(yaw, generator)
        assert float(widths.sum()) == pytest.approx(2 * math.pi, rel=1e-6)
        assert float(yaws[: quadrature.fine].min()) < yaw < float(yaws[: quadrature.fine].max())
        ends = torch.sort(yaws - yaws[0])[0]
        assert float(ends[-1]) < 2 * math.pi


def test_nll_of_blind_features_is_that_of_a_uniform_density() -> None:
    nll = truth_nll(
        torch.zeros(2, 32, 32), torch.zeros(2, 16, 16), (15.2, 16.9, 0.3), 1.0, HeadingQuadrature(), torch.Generator()
    )
    assert float(nll) == pytest.approx(math.log(17 * 17 * 2 * math.pi), rel=1e-5)


TINY = TrainingSettings(
    steps=6,
    batch=2,
    workers=0,
    validate_every=3,
    warmup_steps=2,
    network=NetworkChoice(settings=RotMatchSettings(4, (4, 4, 8, 8))),
)


def test_resuming_gives_the_weights_that_going_on_would_have_given(tmp_path: Path) -> None:
    source, held_out = Landmarks(4), Landmarks(1)

    class StopEarlyError(Exception):
        pass

    def stop_at_four(step: int, steps: int, loss: float, validation: float | None) -> None:
        if step == 4:
            raise StopEarlyError

    straight = train(source, held_out, TINY, tmp_path / "straight")
    with pytest.raises(StopEarlyError):
        train(source, held_out, TINY, tmp_path / "resumed", stop_at_four)
    resumed = train(source, held_out, TINY, tmp_path / "resumed")
    for a, b in zip(straight.parameters(), resumed.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    with pytest.raises(SkyfixError, match="other settings"):
        train(source, held_out, replace(TINY, seed=5), tmp_path / "resumed")


def test_training_learns_to_match(tmp_path: Path) -> None:
    settings = replace(TINY, steps=60, batch=4, learning_rate=5e-3, validate_every=60, augmentation=PLAIN)
    train(Landmarks(16), Landmarks(4), settings, tmp_path)
    blind = math.log(49 * 49 * 2 * math.pi)
    rows = (tmp_path / "loss.csv").read_text().splitlines()
    assert float(rows[-1].split(",")[2]) < blind - 2.0
