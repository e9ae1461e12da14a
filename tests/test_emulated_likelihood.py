"""Emulated measurements: errors are the published ones, densities are calibrated, names say 'emulated'."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from fusion import (
    FG2_KITTI_SAME_AREA,
    ORIENTERNET_KITTI_SEQUENTIAL,
    TRANSLOCNET_KITTI,
    EmulatorSettings,
    ErrorProfile,
    LikelihoodEmulator,
    ParticleFilter,
    SkyfixError,
    se2,
)
from fusion.emulation.emulated_likelihood import cut_normal_quantile
from fusion.likelihood import log_uniform_density

PROFILES = (TRANSLOCNET_KITTI, FG2_KITTI_SAME_AREA, ORIENTERNET_KITTI_SEQUENTIAL)
TRUTH = np.array([310.0, -45.0, 2.6])
AMBIGUOUS = replace(ORIENTERNET_KITTI_SEQUENTIAL, false_mode_share=0.2)


def drawn(profile, count, seed, settings=None, moved_m=np.inf):
    emulator = LikelihoodEmulator(profile, seed, settings)
    return [emulator.measure(TRUTH, moved_m) for _ in range(count)]


def errors_of(likelihoods):
    return se2.between(np.array([each.answer for each in likelihoods]), TRUTH)


def figures_match(profile, position, heading_deg, longitudinal, lateral, slack_m, slack):
    """Mean and median within slack_m metres, recalls within the slack and 0.7 points, the mean heading within 2 %."""
    published = profile.published
    if published.mean_m is not None:
        assert position.mean() == pytest.approx(published.mean_m, abs=slack_m)
    if published.median_m is not None:
        assert np.median(position) == pytest.approx(published.median_m, abs=slack_m)
    if published.heading_mean_deg is not None:
        assert heading_deg.mean() == pytest.approx(published.heading_mean_deg, rel=0.02 + slack)
    for recalls, values in (
        (published.heading_recall, heading_deg),
        (published.longitudinal_recall, longitudinal),
        (published.lateral_recall, lateral),
    ):
        for threshold, recall in recalls.items():
            assert (values < threshold).mean() == pytest.approx(recall, abs=0.007 + slack)


@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_a_profile_has_the_published_figures(profile):
    """By quadrature: 0.01 m, 0.7 points of recall (the worst of the fits), 2 % of the mean heading."""
    share = (np.arange(1000) + 0.5) / 1000
    mixed = [[], [], [], []]
    for sigmas, part in ((profile.core, 1 - profile.tail_share), (profile.tail, profile.tail_share)):
        along, across, heading = (
            np.abs(cut_normal_quantile(share, *of_axis)) for of_axis in zip(sigmas, profile.half_box, strict=True)
        )
        position = np.hypot(along[:, None], across).ravel()
        for values, one in zip(mixed, (position, np.rad2deg(heading), along, across), strict=True):
            values.append(np.quantile(one, (np.arange(round(20_000 * part)) + 0.5) / round(20_000 * part)))
    mixed = [np.concatenate(values) for values in mixed]
    figures_match(profile, *mixed, slack_m=0.012, slack=0.001)


@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_errors_that_are_drawn_have_the_published_figures(profile):
    """4000 draws: four standard errors are 0.4 m of a 6.47 m mean and 3.2 points of a recall of one half."""
    errors = errors_of(drawn(profile, 4000, seed=1))
    position = np.hypot(errors[:, 0], errors[:, 1])
    slack_m = 4 * 1.25 * position.std() / np.sqrt(4000)
    figures_match(
        profile, position, np.abs(np.rad2deg(errors[:, 2])), *np.abs(errors[:, :2]).T, slack_m=slack_m, slack=0.032
    )
    assert (np.abs(errors) <= profile.half_box + 1e-9).all()
    assert profile.name.startswith("emulated")


def content_of_level_set(likelihood, truth, rng):
    """Mass of the density where it is higher than at the truth: uniform when the truth is a draw from it."""
    own = likelihood.sample(300, rng)
    return (likelihood.log_density(own) > likelihood.log_density(truth[None])[0]).mean()


@pytest.mark.parametrize("quality", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("profile", [ORIENTERNET_KITTI_SEQUENTIAL, AMBIGUOUS], ids=["plain", "false modes"])
def test_the_truth_is_a_draw_from_the_stated_density(profile, quality):
    """Level sets hold the share of truths that they state; with 500 draws a shift of 0.1 is found almost surely."""
    rng = np.random.default_rng(2)
    honest = drawn(profile, 500, 3, EmulatorSettings(confidence_quality=quality))
    contents = np.array([content_of_level_set(each, TRUTH, rng) for each in honest])
    assert kstest(contents, "uniform").pvalue > 0.003
    proud = drawn(profile, 500, 3, EmulatorSettings(confidence_quality=quality, overconfidence=1.7))
    contents = np.array([content_of_level_set(each, TRUTH, rng) for each in proud])
    assert kstest(contents, "uniform").pvalue < 1e-6


def test_positions_of_a_network_that_sees_no_heading_are_calibrated_and_headings_say_nothing():
    rng = np.random.default_rng(4)
    contents = [content_of_level_set(each, TRUTH, rng) for each in drawn(TRANSLOCNET_KITTI, 500, 5)]
    assert kstest(contents, "uniform").pvalue > 0.003
    likelihood = drawn(TRANSLOCNET_KITTI, 1, 6)[0]
    turned = TRUTH + np.outer(np.linspace(-3, 3, 50), [0, 0, 1])
    np.testing.assert_allclose(likelihood.log_density(turned), likelihood.log_density(TRUTH[None])[0])


def test_confidence_tells_bad_frames_from_good_ones():
    """The stated weight of the tail explains the stated share of the variance of being bad."""
    for quality in (0.0, 0.3, 1.0):
        each = drawn(
            replace(TRANSLOCNET_KITTI, core=(0.01, 0.01, 1.0)), 1500, 7, EmulatorSettings(confidence_quality=quality)
        )
        bad = (np.abs(errors_of(each)[:, :2]) > 0.05).any(axis=1).astype(float)
        stated = np.array([one.weights[one.sigmas[:, 0] == 10.0].sum() for one in each])
        explained = stated.var() / bad.var()
        assert explained == pytest.approx(quality, abs=0.06)
        assert stated.mean() == pytest.approx(TRANSLOCNET_KITTI.tail_share, abs=4 * 0.5 / np.sqrt(1500))
        assert np.mean(stated - bad) == pytest.approx(0.0, abs=4 * 0.5 / np.sqrt(1500))


@pytest.mark.parametrize("temperature", [1.0, 3.0, 19.0])
@pytest.mark.parametrize("profile", [TRANSLOCNET_KITTI, AMBIGUOUS], ids=["plain", "false modes"])
def test_densities_integrate_to_one_and_samples_follow_them(profile, temperature):
    """Monte Carlo integral over the box by 200,000 points, and a sample's own mean log density against it."""
    rng = np.random.default_rng(8)
    profile = replace(profile, core=(2.0, 1.5, 0.06), heading_is_seen=profile.heading_is_seen)
    likelihood = drawn(profile, 1, 9)[0].tempered(temperature)
    half = np.array([20.0, 20.0, np.pi if not profile.heading_is_seen else profile.half_heading_rad])
    poses = se2.compose(likelihood.answer, rng.uniform(-half, half, (200_000, 3)))
    density = np.exp(likelihood.log_density(poses))
    volume = np.prod(2 * half)
    error = 4 * density.std() * volume / np.sqrt(len(poses))
    assert error < 0.12
    assert density.mean() * volume == pytest.approx(1.0, abs=error + 0.01)
    sample = likelihood.sample(4000, rng)
    assert likelihood.grid.contains(sample[:, :2]).all()
    entropy = -(density * np.log(density)).mean() * volume
    assert -likelihood.log_density(sample).mean() == pytest.approx(entropy, abs=0.12)


def test_tempering_is_the_power():
    likelihood = drawn(AMBIGUOUS, 1, 10)[0]
    poses = likelihood.sample(50, np.random.default_rng(0))
    ratio = likelihood.log_density(poses) / 4.0 - likelihood.tempered(2.0).tempered(2.0).log_density(poses)
    np.testing.assert_allclose(ratio, ratio[0], atol=1e-9)
    assert likelihood.tempered(1.0) is likelihood


def test_modes_are_the_components_with_their_moments():
    likelihood = drawn(AMBIGUOUS, 1, 11)[0]
    mixture = likelihood.modes(3)
    assert mixture.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(likelihood.modes(1).means[0], likelihood.answer, atol=1e-12)
    sample = likelihood.sample(40_000, np.random.default_rng(0))
    mean = mixture.weights @ mixture.means[:, :2]
    about = mixture.means[:, :2] - mean
    expected = np.einsum(
        "m,mij->ij", mixture.weights, mixture.covariances[:, :2, :2] + about[:, :, None] * about[:, None]
    )
    np.testing.assert_allclose(sample[:, :2].mean(axis=0), mean, atol=4 * np.sqrt(np.diag(expected).max() / 40_000))
    np.testing.assert_allclose(np.cov(sample[:, :2].T), expected, rtol=0.05, atol=0.05 * expected.max())


@pytest.mark.parametrize(
    ("settings", "moved", "rho"),
    [
        (EmulatorSettings(step_correlation=0.9), 123.0, 0.9),
        (EmulatorSettings(correlation_length_m=10.0), 4.0, np.exp(-0.4)),
        (EmulatorSettings(), 0.0, 0.0),
    ],
)
def test_errors_repeat_as_stated(settings, moved, rho):
    """One Gaussian component: its errors are an autoregression themselves. 4000 frames, four standard errors."""
    plain = replace(TRANSLOCNET_KITTI, tail_share=0.0, core=(2.0, 1.0, 0.02), heading_is_seen=True)
    errors = errors_of(drawn(plain, 4000, 12, settings, moved))
    scores = errors / plain.core
    found = (scores[1:] * scores[:-1]).mean(axis=0) / (scores**2).mean(axis=0)
    error = 4 * np.sqrt((1 - rho**2) / 4000) + 0.01
    np.testing.assert_allclose(found, rho, atol=error)
    later = (scores[5:] * scores[:-5]).mean(axis=0) / (scores**2).mean(axis=0)
    np.testing.assert_allclose(later, rho**5, atol=3 * error)


def test_bad_frames_come_in_runs_and_each_frame_alone_is_the_profile():
    settings = EmulatorSettings(step_correlation=0.9)
    position = np.hypot(*errors_of(drawn(TRANSLOCNET_KITTI, 5000, 13, settings))[:, :2].T)
    neighbours = np.corrcoef(position[1:], position[:-1])[0, 1]
    assert neighbours > 0.5
    assert position.mean() == pytest.approx(6.47, abs=4 * 5.6 / np.sqrt(5000 / 19))


def test_same_seed_same_measurements():
    a, b, c = (drawn(AMBIGUOUS, 5, seed) for seed in (1, 1, 2))
    assert all((x.answer == y.answer).all() and (x.centres == y.centres).all() for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a[0].answer, c[0].answer)


def test_a_filter_takes_it_and_outliers_are_uniform_over_its_crop():
    likelihood = drawn(TRANSLOCNET_KITTI, 1, 14)[0]
    far = likelihood.with_outliers(0.1).log_density(np.array([[1e4, 0.0, 0.0]]))[0]
    assert far == pytest.approx(np.log(0.1) + log_uniform_density(likelihood.grid))
    assert likelihood.log_density(np.array([[1e4, 0.0, 0.0]]))[0] == likelihood.floor
    particles = ParticleFilter(TRUTH + np.random.default_rng(0).normal(0, [5, 5, 0.1], (2000, 3)), 0)
    for each in drawn(TRANSLOCNET_KITTI, 40, 15):
        particles.update(each)
    assert np.hypot(*(particles.estimate(0).pose - TRUTH)[:2]) < 4 * 2.5 / np.sqrt(20)


def test_bad_values_are_refused_in_one_line():
    likelihood = drawn(AMBIGUOUS, 1, 16)[0]
    for word, call in {
        "emulated": lambda: replace(TRANSLOCNET_KITTI, name="TransLocNet"),
        "tail_share": lambda: replace(TRANSLOCNET_KITTI, tail_share=1.0),
        "false_mode_share": lambda: replace(TRANSLOCNET_KITTI, false_mode_share=0.5),
        "half_extent_m": lambda: replace(TRANSLOCNET_KITTI, half_extent_m=np.inf),
        "half_heading_rad": lambda: replace(TRANSLOCNET_KITTI, half_heading_rad=4.0),
        "standard deviations": lambda: ErrorProfile("emulated", (1.0, 0.0, 1.0), (1.0, 1.0, 1.0), 0.1),
        "correlation_length_m": lambda: EmulatorSettings(correlation_length_m=-1.0),
        "step_correlation": lambda: EmulatorSettings(step_correlation=1.0),
        "confidence_quality": lambda: EmulatorSettings(confidence_quality=1.1),
        "overconfidence": lambda: EmulatorSettings(overconfidence=0.0),
        "true pose": lambda: LikelihoodEmulator(TRANSLOCNET_KITTI, 0).measure([0.0, np.nan, 0.0]),
        "moved_m": lambda: LikelihoodEmulator(TRANSLOCNET_KITTI, 0).measure(TRUTH, -1.0),
        "temperature": lambda: likelihood.tempered(0.0),
        "k >= 1": lambda: likelihood.modes(0),
        "weights": lambda: replace(likelihood, weights=likelihood.weights * 0.5),
        "sigmas": lambda: replace(likelihood, sigmas=-likelihood.sigmas),
        "halves": lambda: replace(likelihood, halves=likelihood.halves * 100.0),
        "poses": lambda: likelihood.log_density(np.zeros((3, 2))),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
