"""Files of a tracker at the edges: numpy's numbers among its settings, paths that cannot be written, damaged bytes."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from made_streams import SECOND, START, answers, feed, streams

from fusion import (
    GaussianLikelihood,
    KldSampling,
    MapGrid,
    OdometryLimits,
    OdometryNoise,
    Outcome,
    ParticleFilterSettings,
    SkyfixError,
    Tracker,
    TrackerSettings,
    UniformPrior,
)
from fusion.hypotheses import HypothesisSettings
from fusion.tracking.archive import read_archive, write_archive

PRIOR = UniformPrior(np.zeros(3), 5.0, 0.3)
SETTINGS = TrackerSettings(
    history_s=np.float32(1.1),
    step_s=np.float64(0.3),
    correlation_length_m=np.float32(7.7),
    max_waiting=np.int64(5),
    noise=OdometryNoise(np.float32(0.13)),
    limits=OdometryLimits(gap_s=np.float32(0.45)),
)
FILTER = ParticleFilterSettings(ess_fraction=np.float32(0.9), outlier_probability=np.float32(0.07), threads=np.int32(1))


def tracker(particles: int = 40) -> Tracker:
    return Tracker.from_prior(PRIOR, particles, SETTINGS, FILTER, seed=3)


def test_settings_hold_pythons_own_numbers_whatever_they_were_given():
    made = [SETTINGS, SETTINGS.noise, SETTINGS.limits, FILTER, KldSampling(np.int64(9), np.int64(99), np.float32(0.1))]
    made += [MapGrid(np.int64(40), np.int16(30), np.float32(0.3), np.float64(1.0), np.float32(2.0))]
    made += [HypothesisSettings(np.float32(0.1))]
    for one in made:
        assert not [entry.name for entry in fields(one) if isinstance(getattr(one, entry.name), np.generic)]
    assert SETTINGS.history_s == np.float32(1.1)
    assert SETTINGS.history_ns == round(1e9 * float(np.float32(1.1)))


def test_a_tracker_with_numpys_numbers_is_saved_and_goes_on_bit_for_bit(tmp_path):
    grid = MapGrid(np.int64(40), np.int64(40), np.float32(5.1), np.float32(-99.9), np.float64(-100.0))
    likelihood = GaussianLikelihood(np.array([5.0, 0.0, 0.1]), np.diag([1.0, 1.0, 0.1]), grid, np.float32(-30.3))
    stamp, messages = START + SECOND // 3, streams(3.0)
    whole = tracker()
    feed(whole, messages[:30])
    whole.add_likelihood(stamp, likelihood.with_outliers(np.float32(0.1)))
    whole.save(tmp_path / "whole.npz")
    resumed = Tracker.load(tmp_path / "whole.npz")
    assert resumed.settings == whole.settings
    same = GaussianLikelihood(likelihood.mean, likelihood.covariance, MapGrid(40, 40, *map(float, (
        grid.metres_per_pixel, grid.x0, grid.y0))), float(np.float32(-30.3)))  # fmt: skip
    assert resumed.add_likelihood(stamp, same.with_outliers(float(np.float32(0.1)))).outcome is Outcome.DUPLICATE
    assert whole.add_likelihood(stamp, same.with_outliers(float(np.float32(0.1)))).outcome is Outcome.DUPLICATE
    assert feed(resumed, messages[30:]) == feed(whole, messages[30:])
    asked = [START + 2 * SECOND, START + 3 * SECOND]
    np.testing.assert_array_equal(answers(resumed, asked), answers(whole, asked))


def test_numpys_scalars_come_back_as_the_numbers_they_were(tmp_path):
    values = [
        np.float32(0.1),
        np.float64(0.1),
        np.float16(3.3),
        np.int64(-(2**63)),
        np.uint8(7),
        np.True_,
        np.str_("ü"),
    ]
    write_archive(tmp_path / "tree", {"values": values, "pair": (np.float32(0.3), 1)})
    back = read_archive(tmp_path / "tree")
    assert back["values"] == values
    assert [type(value) for value in back["values"]] == [float, float, float, int, int, bool, str]
    assert back["pair"] == [float(np.float32(0.3)), 1]
    for odd in (np.complex64(1j), np.datetime64("2020-01-01"), object(), {1, 2}):
        with pytest.raises(SkyfixError, match="archive: expected numbers, strings, lists and arrays, got "):
            write_archive(tmp_path / "odd", [odd])
    assert [entry.name for entry in tmp_path.iterdir()] == ["tree"]


def test_a_path_that_cannot_be_written_is_one_line_and_no_draft_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = tracker()
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"old")
    for path in ("", ".", "..", "folder", "folder/", "file/inside", "no/such", "a\0b", "x" * 300):
        with pytest.raises(SkyfixError, match="expected a file that can be written, got ") as caught:
            one.save(path)
        assert "\n" not in str(caught.value)
    assert sorted(entry.name for entry in tmp_path.rglob("*")) == ["file", "folder"]
    one.save("y" * 255)  # the longest name that file systems allow
    assert Tracker.load("y" * 255).statistics == one.statistics


def test_damaged_files_are_one_line_or_the_tracker_they_were(tmp_path):
    """Bytes changed, cut out, put in and swapped, mostly where zip and npy keep their headers."""
    whole = tracker(3)
    feed(whole, streams(0.3))
    whole.save(tmp_path / "good")
    good, path = (tmp_path / "good").read_bytes(), tmp_path / "bad"
    heads = [i for i in range(len(good) - 4) if good[i : i + 2] == b"PK" or good[i : i + 6] == b"\x93NUMPY"]
    rng = np.random.default_rng(0)
    messages = []
    for trial in range(600):
        data = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.choice(heads)) + int(rng.integers(60)) if trial % 4 else int(rng.integers(len(data)))
            at = min(at, len(data) - 1)
            match rng.integers(4):
                case 0:
                    data[at] = int(rng.integers(256))
                case 1:
                    data[at] ^= 1 << int(rng.integers(8))
                case 2:
                    del data[at : at + int(rng.integers(1, 20))]
                case _:
                    data[at:at] = rng.bytes(int(rng.integers(1, 20)))
        path.write_bytes(data)
        try:
            resumed = Tracker.load(path)
        except SkyfixError as error:
            messages.append(str(error))
        else:
            assert resumed.statistics == whole.statistics
            np.testing.assert_array_equal(answers(resumed, [START]), answers(whole, [START]))
    assert 300 < len(messages) < 600
    assert [line for line in messages if str(path) not in line or "\n" in line] == []


@pytest.mark.parametrize(("offset", "value"), [(8, 99), (8, 14), (8, 9), (6, 1)])
def test_a_compression_or_a_cipher_that_is_not_there_is_one_line(tmp_path, offset, value):
    """In the local header and in the central one, which has the same two bytes later."""
    tracker(3).save(tmp_path / "tracker")
    data = bytearray((tmp_path / "tracker").read_bytes())
    for mark, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        at = data.find(mark)
        while at >= 0:
            data[at + offset + shift] = value
            at = data.find(mark, at + 1)
    (tmp_path / "tracker").write_bytes(data)
    with pytest.raises(SkyfixError, match="expected a saved file, got something else or a damaged one"):
        Tracker.load(tmp_path / "tracker")
