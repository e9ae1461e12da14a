"""A tracker comes back from a file with every setting that it had, and goes on with them bit for bit."""

from dataclasses import fields

import numpy as np
import pytest
from made_streams import SECOND, START, answers, feed, streams

from fusion import (
    FilterAndGraph,
    FixedLagSettings,
    GaussianMixture,
    GraphFilter,
    KldSampling,
    ParticleFilter,
    ParticleFilterSettings,
    Tracker,
    TrackerSettings,
    UniformPrior,
)
from fusion.hypotheses import HypothesisSettings
from fusion.resampling import RESAMPLERS

SETTINGS = TrackerSettings(history_s=1.0, correlation_length_m=7.0)
PRIOR = UniformPrior(np.zeros(3), 5.0, 0.3)
GRAPH = FixedLagSettings(9, 2, 5, 0.07, -8.0, np.inf)
HYPOTHESES = HypothesisSettings(1e-3, 0.4, 2.5)
ASKED = [START + round(t * SECOND) for t in (3.1, 3.3, 3.5)]


def filter_settings(resampler: str) -> ParticleFilterSettings:
    """With no value that is a default."""
    return ParticleFilterSettings(
        resampler,
        ess_fraction=0.8,
        outlier_probability=0.08,
        regularisation=0.4,
        kidnap_probability=2e-3,
        recovery_probability=0.2,
        collapse_log_evidence_margin=2.0,
        injection_share=0.2,
        guided_share=0.3,
        guided_below=20.0,
        adaptive=KldSampling(150, 600, 0.05, 0.95, 0.4, 0.1),
        standstill_m=0.01,
        standstill_rad=0.001,
        threads=2,
    )


def test_every_setting_is_another_than_its_default():
    """Or the tests below could not see that it was lost."""
    pairs = [(filter_settings("residual"), ParticleFilterSettings()), (GRAPH, FixedLagSettings())]
    pairs += [(HYPOTHESES, HypothesisSettings()), (filter_settings("residual").adaptive, KldSampling())]
    for ours, default in pairs:
        assert [entry.name for entry in fields(ours) if getattr(ours, entry.name) == getattr(default, entry.name)] == []


def goes_on(whole: Tracker, tmp_path) -> Tracker:
    """Save amid a drive, load, go on with both; the one that was loaded."""
    messages = streams(4.0)
    feed(whole, messages[:50])
    whole.save(tmp_path / "one.npz")
    resumed = Tracker.load(tmp_path / "one.npz")
    assert feed(resumed, messages[50:]) == feed(whole, messages[50:])
    np.testing.assert_array_equal(answers(resumed, ASKED), answers(whole, ASKED))
    whole.save(tmp_path / "one.npz")
    resumed.save(tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    return resumed


@pytest.mark.parametrize("name", ["filter", "both"])
@pytest.mark.parametrize("resampler", [*RESAMPLERS])
def test_a_filter_with_every_setting_goes_on_bit_for_bit(tmp_path, name, resampler):
    settings = filter_settings(resampler)
    resumed = goes_on(Tracker.from_prior(PRIOR, 200, SETTINGS, settings, 3, name, GRAPH), tmp_path)._timeline.filter
    if isinstance(resumed, FilterAndGraph):
        assert resumed.settings == GRAPH
        resumed = resumed.filter
    assert isinstance(resumed, ParticleFilter)
    assert resumed.settings == settings


def test_a_graph_with_every_setting_goes_on_bit_for_bit(tmp_path):
    starts = GaussianMixture(np.array([0.6, 0.4]), np.array([np.zeros(3), [0.0, 25.0, 0.0]]), np.array([np.eye(3)] * 2))
    resumed = goes_on(Tracker(GraphFilter(starts, GRAPH, HYPOTHESES), SETTINGS, 3), tmp_path)._timeline.filter
    assert (resumed.settings, resumed.hypothesis_settings) == (GRAPH, HYPOTHESES)
