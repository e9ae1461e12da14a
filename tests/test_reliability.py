"""Reliability, coverage and calibration on made-up likelihoods and outcomes whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import expit, logsumexp

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.calibration import (
    Calibration,
    are_right,
    fit_calibration,
    fit_heading_concentration,
    with_heading_concentration,
)
from learned.confidence import fit_confidence, peak_mass, probability
from learned.reliability import expected_calibration_error, highest_density_level, region_coverage, reliability

GRID = MapGrid(30, 40, 0.5, 3.0, -2.0)
YAW_BINS = 36


def bump(kappa: float = 3.0, valid: np.ndarray | None = None) -> LikelihoodVolume:
    """A Gaussian of 2 m at (13, 4), and a von Mises heading about 0.6 that gets surer to the east."""
    x, y = GRID.centres()
    squared = (x[None, :, None] - 13) ** 2 + (y[:, None, None] - 4) ** 2
    yaw = np.arange(YAW_BINS) * 2 * np.pi / YAW_BINS
    sure = kappa * (1 + (x[None, :, None] - 13) / 10)
    return LikelihoodVolume.from_scores(-squared / 8 + sure * np.cos(yaw - 0.6), GRID, valid=valid)


def test_levels_of_true_poses_are_uniform_and_of_sharpened_ones_are_not() -> None:
    """400 poses drawn from the density: coverages within 4 standard errors; too sharp a density covers too little."""
    volume = bump()
    poses = volume.sample(400, np.random.default_rng(0))
    levels = [highest_density_level(volume, pose) for pose in poses]
    masses = (0.1, 0.5, 0.9)
    for mass, found in region_coverage(levels, masses).items():
        assert found == pytest.approx(mass, abs=4 * math.sqrt(mass * (1 - mass) / 400))
    sharp = volume.tempered(0.3)
    too_sure = region_coverage([highest_density_level(sharp, pose) for pose in poses], masses)
    assert too_sure[0.5] < 0.35
    assert too_sure[0.9] < 0.75


def test_levels_at_the_ends() -> None:
    volume = bump(valid=np.arange(YAW_BINS) < 18)
    peak = np.unravel_index(np.argmax(volume.log_prob), volume.log_prob.shape)
    xy = GRID.xy_from_pixel(np.array(peak[:2]) + 0.5)
    yaw = peak[2] * 2 * np.pi / YAW_BINS
    assert highest_density_level(volume, [*xy, yaw]) < 0.01
    assert highest_density_level(volume, [*xy, yaw - 2 * np.pi]) == highest_density_level(volume, [*xy, yaw])
    assert highest_density_level(volume, [*xy, yaw + np.pi]) == 1.0  # not evaluated there
    assert highest_density_level(volume, [0.0, 0.0, yaw]) == 1.0  # outside the crop
    flat = LikelihoodVolume.from_scores(np.zeros((30, 40, 4)), GRID)
    assert highest_density_level(flat, [10.0, 5.0, 0.1]) == pytest.approx(0.5)
    with pytest.raises(SkyfixError, match="levels"):
        region_coverage([])


def test_reliability_of_known_outcomes() -> None:
    chances = [0.05, 0.15, 0.15, 0.95, 0.95, 1.0]
    right = [False, True, False, True, True, False]
    table = reliability(chances, right, bins=10)
    np.testing.assert_array_equal(table.count[[0, 1, 9]], [1, 2, 3])
    assert table.stated[9] == pytest.approx(2.9 / 3)
    assert table.found[9] == pytest.approx(2 / 3)
    assert np.isnan(table.found[5])
    expected = (1 * 0.05 + 2 * 0.35 + 3 * 0.3) / 6
    assert table.expected_calibration_error == pytest.approx(expected)
    assert expected_calibration_error(np.ones(4), np.ones(4, dtype=bool)) == 0.0
    for arguments, message in (
        (([], []), "as many chances as outcomes"),
        (([0.5], [True, False]), "as many chances as outcomes"),
        (([1.2], [True]), r"in \[0, 1\], got 1.2"),
        (([math.nan], [True]), r"in \[0, 1\], got nan"),
        (([0.5], [True], 0), "at least one bin"),
    ):
        with pytest.raises(SkyfixError, match=message):
            reliability(*arguments)


def test_confidence_is_fitted_to_the_odds_that_made_the_outcomes() -> None:
    """4000 outcomes of a logistic with slope 0.5 and intercept -1: found within 15 %, and the error almost gone."""
    rng = np.random.default_rng(2)
    scores = rng.uniform(0.01, 0.99, 4000)
    right = rng.random(4000) < expit(0.5 * np.log(scores / (1 - scores)) - 1.0)
    slope, intercept = fit_confidence(scores, right)
    assert slope == pytest.approx(0.5, rel=0.15)
    assert intercept == pytest.approx(-1.0, rel=0.15)
    assert expected_calibration_error(scores, right) > 0.15
    assert expected_calibration_error(probability(scores, slope, intercept), right) < 0.03
    np.testing.assert_allclose(probability([0.0, 0.25, 1.0], 1.0, 0.0), [1e-6, 0.25, 1 - 1e-6], atol=1e-12)
    always = fit_confidence([0.9, 0.8], [True, True])
    assert 0.5 < probability(0.9, *always)[0] < 1.0
    for bad in (([], []), ([0.5], [True, True])):
        with pytest.raises(SkyfixError, match="as many scores as outcomes"):
            fit_confidence(*bad)
    with pytest.raises(SkyfixError, match=r"scores in \[0, 1\]"):
        probability(math.nan, 1.0, 0.0)


@pytest.mark.parametrize("valid", [None, np.arange(YAW_BINS) < 9], ids=["circle", "sector"])
def test_a_heading_concentration_keeps_the_positions_and_powers_the_headings(valid: np.ndarray | None) -> None:
    volume = bump(valid=valid)
    powered = with_heading_concentration(volume, 2.5)
    position, again = (logsumexp(v.log_prob.astype(float), axis=2) for v in (volume, powered))
    np.testing.assert_allclose(again, position, atol=1e-4)
    evaluated = np.ones(YAW_BINS, dtype=bool) if valid is None else valid
    headings = (v.log_prob[:, :, evaluated] - v.log_prob[:, :, :1] for v in (volume, powered))
    before, after = headings
    np.testing.assert_allclose(after, 2.5 * before, atol=1e-4)
    assert (powered.log_prob[:, :, ~evaluated] == powered.floor).all()
    assert with_heading_concentration(volume, 1.0) is volume


def test_a_known_overconfidence_in_heading_is_found() -> None:
    """Truths of a density whose headings are then sharpened by 3: a third undoes it, positions staying as they are."""
    volume = bump()
    truths = volume.sample(300, np.random.default_rng(1))
    sharp = [with_heading_concentration(volume, 3.0)] * len(truths)
    assert fit_heading_concentration(sharp, truths, outliers=1e-6) == pytest.approx(1 / 3, rel=0.15)
    with pytest.raises(SkyfixError, match="as many volumes as truths"):
        fit_heading_concentration(sharp, truths[:3])
    with pytest.raises(SkyfixError, match="inside the crop"):
        fit_heading_concentration(sharp[:1], np.array([[100.0, 0.0, 0.0]]))


def test_everything_is_fitted_together() -> None:
    volume = bump()
    truths = volume.sample(60, np.random.default_rng(3))
    raw = [with_heading_concentration(volume, 2.0).tempered(0.5)] * len(truths)
    calibration = fit_calibration(raw, truths, factored=True)
    assert calibration.temperature > 1.3
    ready = calibration.applied(raw[0])
    levels = [highest_density_level(ready, truth) for truth in truths]
    assert region_coverage(levels)[0.5] == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(60))
    share = are_right([ready] * len(truths), truths).mean()
    assert calibration.confidence(ready) == pytest.approx(share, abs=0.05)  # one likelihood: the share itself
    assert fit_calibration(raw, truths).heading_concentration == 1.0
    assert Calibration().confidence(ready) == pytest.approx(peak_mass(ready))
    with pytest.raises(SkyfixError, match="calibration temperature: expected above zero, got 0"):
        Calibration(temperature=0.0)
    with pytest.raises(SkyfixError, match="calibration bare_map_correlation_length_m: expected above zero, got -1"):
        Calibration(bare_map_correlation_length_m=-1.0)
    with pytest.raises(SkyfixError, match="calibration confidence_slope: expected a number, got nan"):
        Calibration(confidence_slope=math.nan)
