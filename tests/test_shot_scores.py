"""Scores of single shots against closed forms: uniform and Gaussian densities, the prior's own line, stated chances."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive

from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.calibration import Calibration
from learned.matcher import SearchRegion
from learned.voting import yaw_bins_within
from sequences.evaluate import evaluate_single_shot
from sequences.evaluation_tables import markdown_table, matcher_labels
from sequences.folder import FolderSequence
from sequences.shot_protocol import ShotProtocol
from sequences.shot_scores import (
    OUTLIER_PROBABILITY,
    ShotScore,
    box_nll,
    onto_evaluated,
    score_prior,
    score_shot,
    summarise_shots,
)

GRID = MapGrid(26, 26, 0.75, -9.75, -9.75)
BINS = 36
STEP = se2.TWO_PI / BINS
SIGMAS = np.array([1.2, 1.8, 0.25])


def gaussian_volume(mean: np.ndarray, temperature: float = 1.0) -> LikelihoodVolume:
    x, y = GRID.centres()
    away = se2.wrap(np.arange(BINS) * STEP - mean[2])
    squared = (
        ((x[None, :, None] - mean[0]) / SIGMAS[0]) ** 2
        + ((y[:, None, None] - mean[1]) / SIGMAS[1]) ** 2
        + (away / SIGMAS[2]) ** 2
    )
    return LikelihoodVolume.from_scores(-0.5 * squared, GRID, temperature)


@pytest.mark.parametrize("half_heading_deg", [10.0, 35.0, 180.0])
def test_a_uniform_volume_scores_what_its_box_does(half_heading_deg: float) -> None:
    bins = yaw_bins_within(0.0, math.radians(half_heading_deg), BINS)
    valid = np.zeros(BINS, dtype=np.bool_)
    valid[bins] = True
    volume = LikelihoodVolume.from_scores(np.zeros((26, 26, BINS)), GRID, valid=valid)
    half_searched = len(bins) * STEP / 2
    truth = np.array([3.2, -4.1, 0.0])
    score = score_shot(volume, truth)
    assert score.nll == pytest.approx(box_nll(9.75, half_searched), abs=1e-5)
    assert score.nll_with_floor == pytest.approx(box_nll(9.75, half_searched, OUTLIER_PROBABILITY), abs=1e-5)
    assert score.level == pytest.approx(0.5, abs=1e-6)


def test_the_floor_of_the_box_is_a_mixture() -> None:
    """Written out: 0.95 / (40^2 * 2 * 0.1) + 0.05 / (40^2 * 2 pi); with all headings searched it changes nothing."""
    density = 0.95 / (1600 * 0.2) + 0.05 / (1600 * 2 * math.pi)
    assert box_nll(20.0, 0.1, 0.05) == pytest.approx(-math.log(density))
    assert (
        box_nll(20.0, math.pi, 0.05) == pytest.approx(box_nll(20.0, math.pi)) == pytest.approx(math.log(3200 * math.pi))
    )


def test_a_gaussian_that_is_right_is_covered_as_it_says_and_scores_its_entropy() -> None:
    """400 truths: shares of 0.5 and 0.9 within five standard deviations, 0.125 and 0.075; the NLL within 0.4.

    The standard deviation of a three-dimensional Gaussian's log density is sqrt(1.5), of the mean 0.06; interpolation
    between cells costs h^2 / (12 sigma^2) an axis, 0.09 in all.
    """
    rng = np.random.default_rng(0)
    mean = np.array([0.3, -0.7, 3.0])
    volumes = {temperature: gaussian_volume(mean, temperature) for temperature in (1.0, 0.25)}
    truths = mean + rng.normal(size=(400, 3)) * SIGMAS
    truths[:, 2] = se2.wrap(truths[:, 2])
    right, sure = (
        summarise_shots(truths, [score_shot(volume, truth) for truth in truths], "peak mass")["likelihood"]
        for volume in volumes.values()
    )
    entropy = 1.5 * math.log(2 * math.pi * math.e) + math.log(SIGMAS.prod())
    assert right["nll"] == pytest.approx(entropy, abs=0.4)
    assert right["coverage"]["50"] == pytest.approx(0.5, abs=0.125)
    assert right["coverage"]["90"] == pytest.approx(0.9, abs=0.075)
    assert sure["coverage"]["50"] < 0.3
    assert sure["nll"] > right["nll"] + 0.5
    assert sure["nll_with_floor"] < sure["nll"]


@pytest.mark.parametrize("half_heading_deg", [10.0, 180.0])
def test_the_line_of_the_prior_is_that_of_a_uniform_box(half_heading_deg: float) -> None:
    """20,000 frames; means and shares within five of their standard deviations."""
    half, n = 20.0, 20_000
    truths = np.zeros((n, 3))
    searches = ShotProtocol(half, half_heading_deg, n, seed=1).searches(truths)
    prior = summarise_shots(truths, [score_prior(search) for search in searches], None)
    spread = 5 / math.sqrt(n)
    mean = half * (math.sqrt(2) + math.asinh(1)) / 3
    assert prior["position_error_m"]["mean"] == pytest.approx(mean, abs=spread * 0.29 * half)
    assert prior["heading_error_deg"]["mean"] == pytest.approx(
        half_heading_deg / 2, abs=spread * 0.29 * half_heading_deg
    )
    for limit in (1, 2, 3, 5):
        shares = {
            "position_recall": math.pi * limit**2 / (2 * half) ** 2,
            "lateral_recall": limit / half,
            "longitudinal_recall": limit / half,
            "heading_recall": limit / half_heading_deg,
        }
        for name, share in shares.items():
            assert prior[name][str(limit)] == pytest.approx(share, abs=spread * math.sqrt(share * (1 - share)))
    assert prior["likelihood"]["nll"] == pytest.approx(box_nll(half, math.radians(half_heading_deg)), abs=1e-6)
    assert prior["likelihood"]["coverage"] is None
    assert "confidence" not in prior


def test_beyond_the_last_bin_its_value_holds_for_less_than_a_bin() -> None:
    bins = yaw_bins_within(0.0, 2.4 * STEP, BINS)
    assert sorted(bins) == [0, 1, 2, BINS - 2, BINS - 1]
    valid = np.zeros(BINS, dtype=np.bool_)
    valid[bins] = True
    scores = np.broadcast_to(np.cos(np.arange(BINS) * STEP), (26, 26, BINS))
    volume = LikelihoodVolume.from_scores(scores, GRID, valid=valid)
    for sign in (-1, 1):
        last, beyond, far = (np.array([0.0, 0.0, sign * k * STEP]) for k in (2.0, 2.4, 3.2))
        np.testing.assert_allclose(onto_evaluated(volume, beyond), last, atol=1e-12)
        assert score_shot(volume, beyond).nll == pytest.approx(score_shot(volume, last).nll, abs=1e-6)
        np.testing.assert_array_equal(onto_evaluated(volume, far), far)
        assert score_shot(volume, far).nll == pytest.approx(-volume.floor)
        assert score_shot(volume, far).level == 1.0
    inside = np.array([0.0, 0.0, 0.3 * STEP])
    np.testing.assert_array_equal(onto_evaluated(volume, inside), inside)


def test_stated_chances_are_held_against_what_came_true() -> None:
    truths = np.zeros((10, 3))
    said = [ShotScore(np.zeros(3), 1.0, 1.0, 0.4, 0.8, right=index < 8) for index in range(10)]
    summary = summarise_shots(truths, said, "peak mass")
    assert summary["confidence"] == {
        "source": "peak mass",
        "mean": 0.8,
        "right": 0.8,
        "expected_calibration_error": 0.0,
    }
    boasting = [replace(score, chance=1.0) for score in said]
    assert summarise_shots(truths, boasting, "x")["confidence"]["expected_calibration_error"] == pytest.approx(0.2)
    with pytest.raises(SkyfixError, match="expected a score a truth, got 10 and 9"):
        summarise_shots(truths[:9], said, None)


@dataclass
class _Calibrated(EmulatedMatcher):
    """States the chances that its calibration makes of the mass in its best mode."""

    calibration: Calibration = field(default_factory=Calibration)


def test_chances_are_those_of_a_fitted_calibration(made_drive: MadeDrive) -> None:
    poses = made_drive.truth.poses
    matchers = {
        "none": EmulatedMatcher(poses),
        "not fitted": _Calibrated(poses),
        "never": _Calibrated(poses, calibration=Calibration(confidence_slope=0.0, confidence_intercept=-20.0)),
    }
    found = evaluate_single_shot(FolderSequence(made_drive.path, 0), matchers, ShotProtocol(max_frames=3))["methods"]
    source = {name: found[name]["confidence"]["source"] for name in matchers}
    assert source == {"none": "peak mass", "not fitted": "peak mass", "never": "calibrated peak mass"}
    assert found["none"]["confidence"]["expected_calibration_error"] < 0.05
    assert found["never"]["confidence"]["expected_calibration_error"] == pytest.approx(1.0, abs=1e-6)
    # Half a metre and two degrees: sharper than the box by far, and the truth is where it says.
    assert found["none"]["likelihood"]["nll"] < 3.0 < found["prior"]["likelihood"]["nll"]


def test_files_are_called_by_as_little_as_tells_them_apart() -> None:
    assert matcher_labels(["geometric", "runs/a/hybrid.safetensors", "geometric"]) == {
        "geometric": "geometric",
        "hybrid": "runs/a/hybrid.safetensors",
    }
    assert list(matcher_labels(["rotmatch", "runs/a/rotmatch.safetensors", "runs/b/rotmatch.safetensors"])) == [
        "rotmatch",
        "a/rotmatch",
        "b/rotmatch",
    ]
    alike = ["x/a/n.safetensors", "y/a/n.safetensors"]
    assert list(matcher_labels(alike)) == alike
    assert "prior" not in matcher_labels(["runs/prior.safetensors"])


def test_every_line_of_the_table_has_every_cell(made_drive: MadeDrive) -> None:
    sequence = FolderSequence(made_drive.path, 0)
    matchers = {"emulated": EmulatedMatcher(made_drive.truth.poses)}
    evaluations = [
        evaluate_single_shot(sequence, matchers, ShotProtocol(half_heading_deg=heading, max_frames=3))
        for heading in (10.0, 180.0)
    ]
    rows = [line.strip("| ").split(" | ") for line in markdown_table(evaluations).splitlines()]
    assert {len(row) for row in rows if not row[0].startswith("-")} == {len(rows[0])}
    assert [row[1:3] for row in rows[2:]] == [
        ["±20 m, ±10°", "prior"],
        ["±20 m, ±10°", "emulated"],
        ["±20 m, any heading", "prior"],
        ["±20 m, any heading", "emulated"],
    ]


def test_a_search_holds_the_truth() -> None:
    truths = np.random.default_rng(3).uniform(-3, 3, size=(200, 3))
    for truth, search in zip(truths, ShotProtocol(4.0, 25.0).searches(truths), strict=True):
        assert isinstance(search, SearchRegion)
        assert np.abs(truth[:2] - search.centre[:2]).max() <= 4.0
        assert abs(se2.wrap(truth[2] - search.centre[2])) <= math.radians(25.0) + 1e-12
