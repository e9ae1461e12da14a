"""Every kind of likelihood that skyfix has can be saved within a tracker, and is known again when it is sent twice."""

from __future__ import annotations

import importlib
import pkgutil

import numpy as np
import pytest
from made_streams import SECOND, START, answers, feed, streams

import fusion
from fusion import (
    EmulatedLikelihood,
    GaussianLikelihood,
    LazyOrientation,
    LikelihoodVolume,
    LocationOrientationMaps,
    MapGrid,
    Outcome,
    OutlierMixture,
    ParticleFilterSettings,
    PoseLikelihood,
    Tracker,
    TrackerSettings,
    UniformPrior,
)
from fusion.tracking.archive import read_archive, write_archive
from fusion.tracking.likelihood_tree import is_same_likelihood, likelihood_from_tree, likelihood_tree
from fusion.two_level import TwoLevelLikelihood

PLAN = MapGrid(12, 10, 5.0, -15.0, -25.0)
MEMBERS = ("grid", "searched_volume", "log_density", "sample", "draw_log_density", "modes", "tempered", "with_outliers")


def gaussian():
    return GaussianLikelihood(np.array([5.0, 1.0, 0.1]), np.diag([4.0, 3.0, 0.1]), PLAN, np.float32(-30.1))


def volume():
    scores = np.random.default_rng(0).normal(size=(PLAN.rows, PLAN.cols, 8))
    return LikelihoodVolume.from_scores(scores, PLAN, valid=np.arange(8) != 3)


def maps():
    rng = np.random.default_rng(1)
    shape = (6, PLAN.rows, PLAN.cols)
    return LocationOrientationMaps(rng.normal(size=shape[1:]) - 8.0, rng.normal(size=shape), PLAN, np.float32(0.7))


def lazy():
    rng = np.random.default_rng(2)
    features, head = rng.normal(size=(4, PLAN.rows, PLAN.cols)), rng.normal(size=(6, 4))
    location = rng.normal(size=(PLAN.rows, PLAN.cols)) - 8.0
    return LazyOrientation(location, features, head, rng.normal(size=6), PLAN, np.float32(-37.7))


def two_level():
    rng = np.random.default_rng(3)
    coarse, fine = rng.normal(size=(PLAN.rows, PLAN.cols, 8)), rng.normal(2.0, 1.0, size=(2, 3, 3, 5))
    return TwoLevelLikelihood.from_scores(coarse, PLAN, np.array([[5, 4, 0], [6, 3, 7]]), fine)


def emulated():
    centres = np.array([[0.5, 0.1, 0.02], [0.0, 0.0, 0.0]])
    sigmas = np.array([[1.0, 2.0, 0.1], [np.inf, np.inf, np.inf]])
    halves = np.array([[9.0, 9.0, 0.5], [20.0, 20.0, 3.0]])
    answer, box, weights = np.array([5.0, 1.0, 0.1]), np.full(3, 20.0), np.array([0.9, 0.1])
    return EmulatedLikelihood(answer, box, weights, centres, sigmas, halves, np.float32(1.7), np.float32(-31.3))


def mixture():
    return two_level().with_outliers(np.float32(0.1))


MAKERS = {
    EmulatedLikelihood: emulated,
    GaussianLikelihood: gaussian,
    LazyOrientation: lazy,
    LikelihoodVolume: volume,
    LocationOrientationMaps: maps,
    OutlierMixture: mixture,
    TwoLevelLikelihood: two_level,
}


def kinds_of_fusion() -> set[type]:
    """Every class in the package with all that a `PoseLikelihood` has."""
    modules = [fusion]
    modules += [importlib.import_module(found.name) for found in pkgutil.walk_packages(fusion.__path__, "fusion.")]
    classes = {value for module in modules for value in vars(module).values() if isinstance(value, type)}
    return {one for one in classes if one is not PoseLikelihood and all(hasattr(one, name) for name in MEMBERS)}


def test_no_kind_is_left_out():
    assert kinds_of_fusion() == set(MAKERS)


@pytest.mark.parametrize("kind", MAKERS, ids=lambda kind: kind.__name__)
def test_it_comes_back_bit_for_bit_and_is_known_again(tmp_path, kind):
    likelihood = MAKERS[kind]()
    assert type(likelihood) is kind
    write_archive(tmp_path / "likelihood", likelihood_tree(likelihood))
    back = likelihood_from_tree(read_archive(tmp_path / "likelihood"))
    assert type(back) is kind
    poses = np.random.default_rng(4).uniform([-20.0, -30.0, -np.pi], [40.0, 40.0, np.pi], (300, 3))
    for one, other in ((likelihood, back), (likelihood.tempered(2.0), back.tempered(2.0))):
        np.testing.assert_array_equal(other.log_density(poses), one.log_density(poses))
        drawn = [each.sample(20, np.random.default_rng(5)) for each in (one, other)]
        np.testing.assert_array_equal(*drawn)
    assert back.grid == likelihood.grid
    assert back.searched_volume == likelihood.searched_volume
    assert [other for other, make in MAKERS.items() if is_same_likelihood(back, make())] == [kind]


def test_a_lazy_head_comes_back_as_tempered_as_it_was(tmp_path):
    likelihood = lazy().tempered(3.0)
    write_archive(tmp_path / "likelihood", likelihood_tree(likelihood))
    back = likelihood_from_tree(read_archive(tmp_path / "likelihood"))
    poses = np.random.default_rng(4).uniform([-20.0, -30.0, -np.pi], [40.0, 40.0, np.pi], (300, 3))
    np.testing.assert_array_equal(back.log_density(poses), likelihood.log_density(poses))
    assert is_same_likelihood(back, likelihood)
    assert not is_same_likelihood(back, lazy())


def test_one_that_differs_in_one_number_is_another():
    for make in (lazy, two_level, emulated):
        tree = likelihood_tree(make())
        for name, value in tree.items():
            if isinstance(value, np.ndarray) and name not in ("cut", "weights", "coarse", "fine"):
                other = value.copy()
                other.flat[0] *= 1.01
                assert not is_same_likelihood(likelihood_from_tree({**tree, name: other}), make())


@pytest.mark.parametrize("kind", MAKERS, ids=lambda kind: kind.__name__)
def test_a_tracker_goes_on_with_it_bit_for_bit_and_counts_the_same_again_as_a_duplicate(tmp_path, kind):
    odometry = [message for message in streams(2.0) if message.is_odometry]
    settings = TrackerSettings(history_s=1.0, correlation_length_m=7.0)
    prior, sharing = UniformPrior(np.zeros(3), 5.0, 0.3), ParticleFilterSettings(ess_fraction=0.9)
    whole = Tracker.from_prior(prior, 100, settings, sharing, seed=3)
    early, late = START + SECOND * 7 // 10, START + SECOND * 6 // 5
    feed(whole, odometry[:20])
    assert whole.add_likelihood(early, MAKERS[kind]()).outcome is Outcome.USED
    assert whole.add_likelihood(late, MAKERS[kind]()).outcome is Outcome.WAITING
    whole.save(tmp_path / "whole.npz")
    resumed = Tracker.load(tmp_path / "whole.npz")
    for one in (whole, resumed):
        for stamp in (early, late):
            assert one.add_likelihood(stamp, MAKERS[kind]()).outcome is Outcome.DUPLICATE
        assert one.add_likelihood(early, MAKERS[kind]().with_outliers(0.3)).outcome is Outcome.CONFLICT
    assert feed(resumed, odometry[20:]) == feed(whole, odometry[20:])
    assert resumed.statistics == whole.statistics
    asked = [START + SECOND * tenths // 10 for tenths in (12, 15, 20, 23)]
    np.testing.assert_array_equal(answers(resumed, asked), answers(whole, asked))
    whole.save(tmp_path / "whole.npz")
    resumed.save(tmp_path / "resumed.npz")
    assert (tmp_path / "whole.npz").read_bytes() == (tmp_path / "resumed.npz").read_bytes()
