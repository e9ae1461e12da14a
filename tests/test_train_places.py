"""`skyfix train-places`: from a configuration to an embedding of a network's places, and back into an index."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from made_drive import MadeDrive
from safetensors.torch import load_file

import sequences.train_places
from fusion.errors import SkyfixError
from learned.calibration import Calibration
from learned.place_embedding import PlaceEmbedding
from learned.place_training import PlacePairs, PlaceTraining, pairs_of
from learned.retrieval import Retriever, fingerprint_of
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatch, RotMatchNet, RotMatchSettings
from learned.samples import Sample
from sequences.cli import main
from sequences.train_places import PlaceOptions, recall_among, train_embedding

CONFIG = """
extracts: {"pyrosm:test.osm.pbf": 1.0}
validation_extract: pyrosm:test.osm.pbf
validation_samples: 6
simulation: {samples: 8, samples_per_area: 4, azimuths: [300, 300], bev_half_extent_m: 24.0}
training: {network: {bev: {half_extent_m: 24.0}}}
"""
RINGS = RingHarmonics((4.0, 8.0, 16.0), orders=4, cell_m=2.0, reach_m=24.0)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("places") / "near.yaml"
    path.write_text(CONFIG)
    return path


@pytest.fixture
def options(config: Path) -> PlaceOptions:
    return PlaceOptions("rotmatch", 2, config.parent / "cache", PlaceTraining(size=4, steps=3), RINGS)


def test_an_embedding_comes_out_with_its_provenance_and_answers_for_its_network(
    config: Path, options: PlaceOptions, made_drive: MadeDrive, tmp_path: Path
) -> None:
    told: list[tuple[int, int]] = []
    out = tmp_path / "new" / "places.safetensors"
    facts = train_embedding(config, tmp_path, out, options, lambda done, total: told.append((done, total)))
    assert told == [(number, 10) for number in range(1, 11)]
    assert json.loads(out.with_suffix(".json").read_text()) == facts
    assert facts["command"] == "skyfix train-places near.yaml --matcher rotmatch --scans-per-area 2"
    assert (facts["samples"], facts["settings"]["steps"]) == (4, 3)
    assert facts["config"]["simulation"]["bev_half_extent_m"] == 24.0
    assert facts["validation"]["places"] == 6
    assert facts["validation"]["prior"] == {"1": 0.167, "5": 0.833, "10": 1.0}
    assert facts["validation"]["recall"]["10"] == 1.0
    embedding = PlaceEmbedding.load(out)
    shipped = RotMatch.shipped()
    assert embedding.network == facts["network"] == fingerprint_of(shipped.net)
    assert Retriever(shipped, embedding)
    again = tmp_path / "again.safetensors"
    train_embedding(config, tmp_path, again, options)
    for name, values in load_file(out).items():
        assert torch.equal(load_file(again)[name], values), name
    assert not list(tmp_path.rglob("*.part"))
    assert not list(tmp_path.rglob("cache"))
    assert options.cache_dir is not None
    assert len(list((options.cache_dir / "training").glob("area_*.npz"))) == 2


def test_places_are_shown_beside_where_the_scans_were_taken(
    config: Path, options: PlaceOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By up to 3 m along each axis, those of the unseen scans too."""
    offsets: list[np.ndarray] = []

    def watched(net: RotMatchNet, samples: Iterable[tuple[Sample, np.ndarray]], harmonics: RingHarmonics) -> PlacePairs:
        kept = list(samples)
        offsets.append(np.array([offset for _, offset in kept]))
        return pairs_of(net, kept, harmonics)

    monkeypatch.setattr(sequences.train_places, "pairs_of", watched)
    train_embedding(config, tmp_path, tmp_path / "places.safetensors", options)
    assert [len(each) for each in offsets] == [4, 6]
    for each in offsets:
        assert (np.abs(each) <= 3.0).all()
        assert len(np.unique(each)) == each.size
        assert np.abs(each).max() > 1.0


def test_a_scan_that_looks_like_its_own_place_and_no_other_is_found() -> None:
    generator = torch.Generator().manual_seed(0)
    seen = torch.randn(20, 9, 5, generator=generator, dtype=torch.complex64)
    weights = torch.randn(5, 9, 4, generator=generator, dtype=torch.complex64)
    embedding = PlaceEmbedding(weights, weights, *torch.zeros(2, 9), "", RINGS)
    turned = seen * torch.exp(1j * torch.arange(5) * torch.linspace(-3.0, 3.0, 20)[:, None])[:, None]
    yaws, positions = torch.zeros(20), torch.zeros(20, 2)
    right = PlacePairs(turned, seen, yaws, positions)
    assert recall_among(embedding, right)["recall"] == {"1": 1.0, "5": 1.0, "10": 1.0}
    swapped = PlacePairs(turned, seen.roll(1, 0), yaws, positions)
    assert recall_among(embedding, swapped)["recall"]["1"] == 0.0
    all_alike = PlacePairs(seen[:1].expand_as(seen), seen, yaws, positions)
    assert recall_among(embedding, all_alike)["recall"]["1"] == 1 / 20  # ranked are places for a scan, not scans


def test_the_command_trains_and_retrieve_takes_what_it_wrote(
    config: Path,
    options: PlaceOptions,
    made_drive: MadeDrive,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    torch.manual_seed(0)
    own = RotMatch(RotMatchNet(RotMatchSettings(4, (4, 4, 8, 8))), Calibration())
    monkeypatch.setattr("learned.matcher.load_matcher", lambda name: own if name == "own" else RotMatch.shipped())
    monkeypatch.setattr(sequences.train_places, "load_matcher", lambda name: own if name == "own" else None)
    monkeypatch.setattr(
        sequences.train_places,
        "PlaceOptions",
        lambda matcher, scans, cache, training: PlaceOptions(matcher, scans, cache, options.training, RINGS),
    )

    def skyfix(*arguments: str) -> tuple[int | str | None, str, str]:
        monkeypatch.setattr(sys, "argv", ["skyfix", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        printed = capsys.readouterr()
        return caught.value.code, printed.out, printed.err

    out = str(tmp_path / "places.safetensors")
    train = ("train-places", str(config), "--out", out, "--cache", str(options.cache_dir), "--scans-per-area", "1")
    code, said, _ = skyfix(*train, "--matcher", "own")
    assert code == 0
    assert said.startswith(f"embedding: {out}; of 6 unseen scans and their places, its own is ")
    assert said.endswith(" % among the best 5, 100 % among the best 10\n")
    code, _, error = skyfix(*train)
    assert (code, error) == (2, "skyfix: error: --matcher: expected rotmatch or a checkpoint of it, got rotmatch\n")
    retrieve = ("retrieve", str(made_drive.path), "--embedding", out, "--max-frames", "2", "--shortlist", "5")
    code, said, _ = skyfix(*retrieve, "--matcher", "own")
    assert code == 0
    assert "2 real scans looked up among 4 tiles" in said
    code, _, error = skyfix(*retrieve)
    assert code == 2
    assert "place embedding: expected one of the features of weights" in error


def test_what_does_not_fit_is_one_line_before_anything_is_simulated(
    config: Path, options: PlaceOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequences.train_places, "SimulatedSamples", None)
    with pytest.raises(SkyfixError, match=r"near\.yaml: expected scans simulated to 72 m, got 24 m"):
        train_embedding(config, tmp_path, tmp_path / "a.safetensors")
    with pytest.raises(SkyfixError, match=r"--out: expected a file ending in \.safetensors, got a\.bin"):
        train_embedding(config, tmp_path, tmp_path / "a.bin", options)
    (tmp_path / "file").write_text("")
    with pytest.raises(SkyfixError, match="file"):
        train_embedding(config, tmp_path, tmp_path / "file" / "a.safetensors", options)
    with pytest.raises(SkyfixError, match="--scans-per-area: expected 1 or more, got 0"):
        PlaceOptions(scans_per_area=0)


class Numbered:
    """Neighbourhoods whose samples are numbers."""

    areas = 3

    def __init__(self, of_area: int) -> None:
        self._of_area = of_area

    def area(self, number: int) -> list[tuple[int, int]]:
        return [(number, index) for index in range(self._of_area)]


@pytest.mark.parametrize("of_area", [1, 4, 6, 7, 8, 16])
def test_an_area_shows_all_its_samples_before_one_is_shown_again(of_area: int) -> None:
    shown = [sample for sample, _ in sequences.train_places._displaced(Numbered(of_area), 2 * of_area, 0)]
    assert len(set(shown[: 3 * of_area])) == len(set(shown)) == 3 * of_area
    assert set(shown[3 * of_area :]) == set(shown)


def test_the_samples_of_the_shipped_embedding_are_those_that_it_was_trained_on() -> None:
    """Four of sixteen, far apart."""
    shown = [sample for sample, _ in sequences.train_places._displaced(Numbered(16), 4, 0)]
    assert shown == [(area, 4 * turn + area) for turn in range(4) for area in range(3)]
