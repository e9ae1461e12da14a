"""The loss is a density, resuming changes nothing, and RotMatch learns."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from landmarks import Landmarks

from fusion.errors import SkyfixError
from learned.losses import HeadingQuadrature, scores_nll
from learned.rotmatch import RotMatchSettings
from learned.samples import Augmentation
from learned.training import NetworkChoice, TrainingSettings, train

PLAIN = Augmentation(drop_class=0.0, thin=0.0, shorten=0.0, drop_sector=0.0, drop_band=0.0)


def test_quadrature_covers_the_circle_once() -> None:
    quadrature = HeadingQuadrature()
    generator = torch.Generator().manual_seed(0)
    for yaw in (-3.0, 0.0, 2.5):
        yaws, widths = quadrature.draw(yaw, generator)
        assert float(widths.sum()) == pytest.approx(2 * math.pi, rel=1e-6)
        assert float(yaws[: quadrature.fine].min()) < yaw < float(yaws[: quadrature.fine].max())
        ends = torch.sort(yaws - yaws[0])[0]
        assert float(ends[-1]) < 2 * math.pi


def test_nll_of_equal_scores_is_that_of_a_uniform_density() -> None:
    quadrature = HeadingQuadrature()
    yaws, widths = quadrature.draw(0.3, torch.Generator())
    nll = scores_nll(torch.zeros(len(yaws), 17, 17), (7.2, 8.9, 0.3), yaws, widths, 1.0, quadrature)
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
