"""Augmentation: truth, scan and map stay together, and what is off draws nothing that others had before."""

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from landmarks import landmark_sample

from fusion import se2
from learned.network import Batch
from learned.samples import Augmentation, Example, augment

PLAIN = Augmentation(drop_class=0.0, thin=0.0, shorten=0.0, drop_sector=0.0, drop_band=0.0)


def share_of_returns_on_walls(example: Example) -> float:
    """How many of the returns that fall into the crop have a wall within 3 pixels."""
    rows, cols = np.nonzero(example.density[1])
    ahead, left = cols + 0.5 - 80, 80 - (rows + 0.5)
    top = example.row - (math.sin(example.yaw) * ahead + math.cos(example.yaw) * left)
    side = example.col + (math.cos(example.yaw) * ahead - math.sin(example.yaw) * left)
    seen = (top > 4) & (top < 252) & (side > 4) & (side < 252)
    walls = (example.picture == example.picture.max(axis=(0, 1))).all(axis=-1)
    near = [walls[int(t) - 3 : int(t) + 4, int(s) - 3 : int(s) + 4].any() for t, s in zip(top, side, strict=True)]
    assert seen.sum() > 50
    return float(np.array(near)[seen].mean())


@given(seed=st.integers(0, 10_000))
@settings(max_examples=15)
def test_augmentation_moves_truth_scan_and_map_together(seed: int) -> None:
    example = augment(landmark_sample(seed % 7), np.random.default_rng(seed), PLAIN)
    assert share_of_returns_on_walls(example) > 0.99


@given(seed=st.integers(0, 10_000))
@settings(max_examples=15)
def test_a_turned_map_turns_the_truth_with_it(seed: int) -> None:
    sample = landmark_sample(seed % 7)
    straight = augment(sample, np.random.default_rng(seed), PLAIN)
    turned = augment(sample, np.random.default_rng(seed), replace(PLAIN, rotate=1.0))
    angle = float(se2.wrap(turned.yaw - straight.yaw))
    assert (turned.row, turned.col) == (straight.row, straight.col)
    assert 0 < abs(angle) < math.radians(60)
    assert float(se2.wrap(turned.prior_yaw - straight.prior_yaw - angle)) == pytest.approx(0.0, abs=1e-9)
    assert share_of_returns_on_walls(turned) > 0.95
    np.testing.assert_array_equal(turned.density, straight.density)


def test_how_often_and_how_far_maps_are_turned() -> None:
    """200 draws at one in four within 30 degrees: a share within 4 standard errors, and angles over the whole range."""
    sample, angles = landmark_sample(0), []
    some = replace(PLAIN, rotate=0.25, rotate_deg=30.0, crop_px=64)
    for seed in range(200):
        straight, maybe = (
            augment(sample, np.random.default_rng(seed), how) for how in (replace(PLAIN, crop_px=64), some)
        )
        angles.append(math.degrees(float(se2.wrap(maybe.yaw - straight.yaw))))
    turned = np.array(angles)[np.abs(angles) > 1e-6]
    assert len(turned) == pytest.approx(50, abs=4 * math.sqrt(200 * 0.25 * 0.75))
    assert np.abs(turned).max() < 30.0
    assert turned.min() < -15.0
    assert turned.max() > 15.0


def test_colours_are_jittered_and_nothing_else() -> None:
    sample = landmark_sample(1)
    plain = augment(sample, np.random.default_rng(5), PLAIN)
    jittered = augment(sample, np.random.default_rng(5), replace(PLAIN, colour_jitter=0.4))
    assert jittered.picture.dtype == np.uint8
    assert (jittered.picture != plain.picture).any()
    for name in ("row", "col", "yaw", "prior_yaw"):
        assert getattr(jittered, name) == getattr(plain, name)
    # One map colour stays one colour: the jitter is of the picture, not of its pixels.
    colours = {tuple(colour) for colour in plain.picture.reshape(-1, 3)}
    assert len({tuple(colour) for colour in jittered.picture.reshape(-1, 3)}) == len(colours)


@pytest.mark.parametrize("half_deg", [180.0, 10.0, 0.0])
def test_the_heading_known_beforehand_is_as_good_as_it_is_said_to_be(half_deg: float) -> None:
    """Uniform: 200 draws have a mean square within 4 standard errors of a third of the half width's."""
    how = replace(PLAIN, half_heading_deg=half_deg, crop_px=64)
    examples = [augment(landmark_sample(0), np.random.default_rng(seed), how) for seed in range(200)]
    errors = np.degrees([float(se2.wrap(e.prior_yaw - e.yaw)) for e in examples])
    assert np.abs(errors).max() <= half_deg + 1e-9
    assert np.mean(errors**2) == pytest.approx(half_deg**2 / 3, abs=4 * half_deg**2 * math.sqrt(4 / 45 / 200) + 1e-12)


def test_defaults_draw_what_the_shipped_weights_were_trained_on() -> None:
    """The digest is of version 0.1.0's augmentation: crops, blanked classes, truths and which cells have returns."""
    digest = hashlib.sha256()
    for seed in range(40):
        example = augment(landmark_sample(seed % 7), np.random.default_rng(seed), Augmentation())
        truth = np.round([example.row, example.col, example.yaw], 9)
        for values in (example.density > 0, example.picture, truth):
            digest.update(np.ascontiguousarray(values).tobytes())
    assert digest.hexdigest()[:16] == "0eefca2376ba264a"


def test_a_batch_holds_its_examples() -> None:
    examples = [augment(landmark_sample(seed), np.random.default_rng(seed), Augmentation()) for seed in range(3)]
    batch = Batch.of(examples, first=5)
    assert len(batch) == 3
    assert batch.first == 5
    for index, example in enumerate(examples):
        np.testing.assert_array_equal(batch.density[index].numpy(), example.density)
        picture = np.moveaxis(batch.picture[index].numpy(), 0, -1)
        np.testing.assert_array_equal(np.rint(picture * 255), example.picture)
        for name in ("row", "col", "yaw", "prior_yaw"):
            assert float(getattr(batch, name)[index]) == getattr(example, name)
