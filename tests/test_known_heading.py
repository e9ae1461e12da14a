"""A network that turns scans by a heading known beforehand is asked about such headings alone; others about all."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

import sequences.train_command
from fusion import se2
from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from learned.architectures import ARCHITECTURES
from learned.calibration import match_samples
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from learned.samples import Augmentation
from learned.training_settings import NetworkChoice, TrainingSettings
from learned.translocnet_matcher import TransLocNetMatcher
from learned.voting_net import VotingMatcher
from sequences.ablate import AblateOptions, ablate
from sequences.train_command import TrainOptions, train_from_config

BEV = {"half_extent_m": 16.0}
COMPACT = {
    "architecture": "translocnet-compact",
    "bev": BEV,
    "crop_px": 128,
    "backbone": {"stem_width": 8, "stem_kernel": 3, "stem_stride": 1, "widths": [8, 8, 8, 8], "blocks": [1, 1, 1, 1]},
    "channels": 8,
    "heads": 2,
    "decoder_widths": [8, 8, 8, 8],
    "yaw_bins": 72,
}
VOTING = {"architecture": "hybrid", "channels": 4, "widths": [8, 8, 8, 8], "bev": BEV}


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache for both networks: the samples are the same."""
    return tmp_path_factory.mktemp("samples")


def config(network: dict[str, Any], folder: Path) -> Path:
    path = folder / "tiny.yaml"
    content = {
        "extracts": {"pyrosm:test.osm.pbf": 1.0},
        "validation_extract": "pyrosm:test.osm.pbf",
        "validation_samples": 1,
        "calibration_samples": 4,
        "matching_half_extent_m": 16.0,
        "simulation": {"samples": 2, "samples_per_area": 2, "azimuths": [90, 90], "bev_half_extent_m": 16.0},
        "training": {
            "steps": 1,
            "batch": 2,
            "workers": 0,
            "augmentation": {"half_heading_deg": 12.0, "crop_px": 128, "max_offset_px": 20},
            "network": network,
        },
    }
    path.write_text(yaml.safe_dump(content))
    return path


def spy(monkeypatch: pytest.MonkeyPatch, matcher: type) -> list[SearchRegion]:
    """The searches that a kind of matcher is handed from now on."""
    seen: list[SearchRegion] = []
    match_counts = matcher.match_counts

    def match(self: Any, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion) -> LikelihoodVolume:
        seen.append(search)
        return match_counts(self, counts, map_raster, search)

    monkeypatch.setattr(matcher, "match_counts", match)
    return seen


def test_translocnet_is_validated_calibrated_and_ablated_where_it_was_trained(
    tmp_path: Path, samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = spy(monkeypatch, TransLocNetMatcher)
    config(COMPACT, tmp_path)
    ablation = tmp_path / "parts.yaml"
    ablation.write_text("base: tiny.yaml\nevaluation_samples: 2\nvariants: {full: {}}")
    with pytest.raises(SkyfixError, match=r"--half-heading-deg: expected at most 12, what variant 'full' .*, got 180"):
        ablate(ablation, tmp_path, tmp_path / "out", options=AblateOptions(half_headings_deg=(12.0, 180.0)))
    assert not (tmp_path / "out").exists()
    trues: list[NDArray[np.float64]] = []

    def with_truths(*arguments: Any, **named: Any) -> tuple[list[LikelihoodVolume], NDArray[np.float64]]:
        volumes, truths = match_samples(*arguments, **named)
        trues.extend(truths)
        return volumes, truths

    monkeypatch.setattr(sequences.train_command, "match_samples", with_truths)
    ablate(ablation, tmp_path, tmp_path / "out", options=AblateOptions(cache_dir=samples))
    assert len(trues) == 1 + 4
    for search, truth in zip(seen, trues, strict=False):  # the scan is turned by the centre
        assert abs(se2.wrap(search.centre[2] - truth[2])) <= math.radians(12.0) + 1e-9
    assert len(seen) == 1 + 4 + 2
    for search in seen:
        assert search.half_heading_rad == pytest.approx(math.radians(12.0))
    checkpoint = tmp_path / "out" / "runs" / "full" / "seed-0" / "translocnet-compact.json"
    validation = json.loads(checkpoint.read_text())["validation"]
    assert validation["half_heading_deg"] == 12.0
    assert validation["nll"] < 15.0  # a truth just beyond the last bin that is searched does not count as impossible


def test_a_voting_network_is_calibrated_over_all_headings(
    tmp_path: Path, samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = spy(monkeypatch, VotingMatcher)
    options = TrainOptions(cache_dir=samples)
    checkpoint = train_from_config(config(VOTING, tmp_path), tmp_path, tmp_path / "out", options=options)
    assert len(seen) == 1 + 4
    assert {search.half_heading_rad for search in seen} == {math.pi}
    assert json.loads(checkpoint.with_suffix(".json").read_text())["validation"]["half_heading_deg"] == 180.0


def test_only_those_that_turn_the_scan_need_the_heading() -> None:
    needing = {name for name, architecture in ARCHITECTURES.items() if architecture.needs_heading}
    assert needing == {"translocnet", "translocnet-compact"}
    exact, compact = Augmentation(half_heading_deg=0.0), NetworkChoice("translocnet-compact")
    assert TrainingSettings(augmentation=exact).known_half_heading_deg == 180.0
    with pytest.raises(SkyfixError, match=r"augmentation\.half_heading_deg: expected above 0 and at most 180, got 0"):
        TrainingSettings(network=compact, augmentation=exact)
