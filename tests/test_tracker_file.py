"""A tracker that is saved goes on from the file bit for bit, wherever it was cut, and a bad file is one line."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_streams import GRID, SECOND, START, KalmanFilter, Message, answers, feed, odometry_at, shuffled, streams

from fusion import (
    GaussianLikelihood,
    LikelihoodVolume,
    LocationOrientationMaps,
    MapGrid,
    OdometryIncrement,
    OdometryLimits,
    OdometryNoise,
    Outcome,
    ParticleFilterSettings,
    SkyfixError,
    Tracker,
    TrackerSettings,
    UniformPrior,
)
from fusion.tracking.archive import read_archive, write_archive
from fusion.tracking.likelihood_tree import is_same_likelihood, likelihood_from_tree, likelihood_tree

SETTINGS = TrackerSettings(
    history_s=1.0,
    correlation_length_m=7.0,
    max_waiting=5,
    noise=OdometryNoise(0.2),
    limits=OdometryLimits(gap_s=0.4, max_speed_m_per_s=50.0),
)
FILTER = ParticleFilterSettings(resampler="residual", ess_fraction=0.9)
ASKED = [START + round(t * SECOND) for t in (2.1, 2.6, 3.0, 3.4)]


def tracker(seed=3) -> Tracker:
    return Tracker.from_prior(UniformPrior(np.zeros(3), 5.0, 0.3), 40, SETTINGS, FILTER, seed=seed)


def awkward_streams() -> list[Message]:
    """Late and shuffled, with a gap, a reset, a stray stamp, a conflict, and a clock that jumps near the end."""
    messages = streams(3.0)
    delays = np.random.default_rng(5).integers(0, 400, len(messages))
    messages = [m for m in shuffled(messages, delays) if not 0 < m.stamp_ns - START - SECOND < SECOND // 2]
    messages[10:10] = [Message(START + 3600 * SECOND, odometry_at(START))]
    messages[20:20] = [Message(messages[19].stamp_ns, odometry_at(START))]
    return [*messages, *(Message(START + 9 * SECOND + i, odometry_at(START + 3 * SECOND + i)) for i in range(4))]


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, len(awkward_streams())))
def test_a_saved_tracker_goes_on_bit_for_bit_wherever_it_was_cut(tmp_path, cut):
    messages = awkward_streams()
    whole = tracker()
    feed(whole, messages[:cut])
    path = tmp_path / "tracker.npz"
    whole.save(path)
    resumed = Tracker.load(path)
    assert resumed.settings == whole.settings
    assert resumed.statistics == whole.statistics
    assert feed(resumed, messages[cut:]) == feed(whole, messages[cut:])
    assert resumed.statistics == whole.statistics
    np.testing.assert_array_equal(answers(resumed, ASKED), answers(whole, ASKED))
    whole.save(path)
    resumed.save(tmp_path / "resumed.npz")
    assert path.read_bytes() == (tmp_path / "resumed.npz").read_bytes()


def volume() -> LikelihoodVolume:
    scores = np.random.default_rng(0).normal(size=(6, 5, 8)).astype(np.float32)
    return LikelihoodVolume.from_scores(scores, MapGrid(6, 5, 2.0, -3.0, -4.0), valid=np.arange(8) != 3)


def maps() -> LocationOrientationMaps:
    rng = np.random.default_rng(1)
    return LocationOrientationMaps(rng.normal(size=(4, 5)), rng.normal(size=(6, 4, 5)), MapGrid(4, 5, 1.0, 0, 0), 0.7)


LIKELIHOODS = [
    GaussianLikelihood(np.array([1.0, 2.0, 3.0]), np.diag([1.0, 2.0, 0.1]), GRID, -30.0),
    volume(),
    maps(),
    volume().with_outliers(0.2),
    volume().with_outliers(0.3),
]


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
def test_every_likelihood_comes_back_from_a_file_as_it_was(tmp_path, likelihood):
    write_archive(tmp_path / "likelihood", likelihood_tree(likelihood))
    back = likelihood_from_tree(read_archive(tmp_path / "likelihood"))
    poses = np.random.default_rng(2).uniform(-4.0, 5.0, (50, 3))
    np.testing.assert_array_equal(back.log_density(poses), likelihood.log_density(poses))
    assert [is_same_likelihood(back, other) for other in LIKELIHOODS] == [other is likelihood for other in LIKELIHOODS]
    one = tracker()
    one.add_likelihood(START, likelihood)
    one.save(tmp_path / "tracker.npz")
    assert Tracker.load(tmp_path / "tracker.npz").add_likelihood(START, back).outcome is Outcome.DUPLICATE


def test_increments_and_another_filter_are_saved_too(tmp_path):
    def kalman() -> KalmanFilter:
        return KalmanFilter(np.zeros(3), np.eye(3))

    def step(one: Tracker, i: int) -> None:
        one.add_increment(OdometryIncrement(START + i * SECOND // 20, np.array([0.5, 0.0, 0.01]), 1e-4 * np.eye(3)))

    whole = Tracker(kalman(), SETTINGS)
    for i in range(30):
        step(whole, i)
    whole.save(tmp_path / "tracker.npz")
    resumed = Tracker.load(tmp_path / "tracker.npz", KalmanFilter(np.ones(3), 2.0 * np.eye(3)))
    for i in range(30, 50):
        step(whole, i)
        step(resumed, i)
    np.testing.assert_array_equal(resumed.estimate().pose, whole.estimate().pose)
    np.testing.assert_array_equal(resumed.estimate().covariance, whole.estimate().covariance)
    with pytest.raises(SkyfixError, match="expected a KalmanFilter to put the state into, got none"):
        Tracker.load(tmp_path / "tracker.npz")
    tracker().save(tmp_path / "particles.npz")
    with pytest.raises(SkyfixError, match="expected a ParticleFilter to put the state into, got KalmanFilter"):
        Tracker.load(tmp_path / "particles.npz", kalman())


class OwnLikelihood:
    """A likelihood that skyfix does not know."""

    grid = GRID

    def log_density(self, poses):
        return np.full(len(poses), -3.0)


def test_a_likelihood_of_an_unknown_type_cannot_be_saved_and_the_old_file_stays(tmp_path):
    path = tmp_path / "tracker.npz"
    one = tracker()
    one.save(path)
    before = path.read_bytes()
    one.add_likelihood(START, OwnLikelihood())
    with pytest.raises(SkyfixError, match=r"likelihood: expected one of GaussianLikelihood, .* to write, got OwnLike"):
        one.save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["tracker.npz"]


def test_there_is_no_pickle_in_the_file(tmp_path):
    one = tracker()
    feed(one, awkward_streams()[:40])
    one.save(tmp_path / "tracker.npz")
    with np.load(tmp_path / "tracker.npz", allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "fiu" for name in file.files)
        assert json.loads(file["json"].tobytes())["format"] == "skyfix tracker"
    with pytest.raises(SkyfixError, match="archive: expected arrays of numbers, got object"):
        write_archive(tmp_path / "object", np.array([None]))


def test_a_bad_file_is_one_line(tmp_path):
    good, path = tmp_path / "good.npz", tmp_path / "bad.npz"
    one = tracker()
    feed(one, streams(0.5))
    one.save(good)
    whole = good.read_bytes()
    with pytest.raises(SkyfixError, match=r"missing\.npz: expected a saved file, got No such file"):
        Tracker.load(tmp_path / "missing.npz")
    with pytest.raises(SkyfixError, match="expected a file that can be written, got No such file"):
        one.save(tmp_path / "no" / "folder.npz")
    for content in (b"", b"text", whole[: len(whole) // 2], whole[:2000] + bytes(500) + whole[2500:]):
        path.write_bytes(content)
        with pytest.raises(SkyfixError, match=r"bad\.npz: expected a saved (file|tracker)") as caught:
            Tracker.load(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: {**tree, "version": 99}, "expected a saved tracker of version 3"),
        (lambda tree: {**tree, "format": "else"}, "expected a saved tracker of version 3"),
        (lambda tree: ["a list"], "expected a saved tracker of version 3"),
        (lambda tree: {k: v for k, v in tree.items() if k != "history"}, "with parts missing or damaged"),
        (lambda tree: {**tree, "history": []}, "with parts missing or damaged"),
        (lambda tree: {**tree, "settings": {**tree["settings"], "colour": 1}}, "with parts missing or damaged"),
        (lambda tree: {**tree, "settings": {**tree["settings"], "history_s": -1.0}}, "history_s: expected at least"),
    ],
)
def test_a_file_with_other_content_is_one_line(tmp_path, change, message):
    path = tmp_path / "tracker.npz"
    tracker().save(path)
    write_archive(path, change(read_archive(path)))
    with pytest.raises(SkyfixError, match=message) as caught:
        Tracker.load(path)
    assert "\n" not in str(caught.value)


def test_numbers_and_arrays_come_back_from_an_archive_bit_for_bit(tmp_path):
    floats = np.random.default_rng(0).standard_normal(100) * 10.0 ** np.arange(-150, 150, 3)
    tree = {
        "floats": floats.tolist(),
        "stamps": [2**63 - 1, -(2**63)],
        "nested": [{"array": floats}, [np.arange(3, dtype=np.float32), None, True, "ü"]],
        "endless": [np.inf, {"least": -np.inf}],
    }
    write_archive(tmp_path / "tree", tree)
    back = read_archive(tmp_path / "tree")
    assert back["floats"] == tree["floats"]
    assert back["stamps"] == tree["stamps"]
    np.testing.assert_array_equal(back["nested"][0]["array"], floats)
    assert back["nested"][1][0].dtype == np.float32
    assert back["nested"][1][1:] == [None, True, "ü"]
    assert back["endless"] == tree["endless"]
    assert zipfile.is_zipfile(tmp_path / "tree")
    for key in ("array", "float"):
        with pytest.raises(SkyfixError, match=rf"archive: expected keys other than \${key}"):
            write_archive(tmp_path / "tree", {f"${key}": 1})
