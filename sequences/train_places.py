"""`skyfix train-places CONFIG`: an embedding of places for a trained RotMatch, from scans simulated as in training.

Written as a whole or not at all: FILE.safetensors, and beside it FILE.json with the command, the configuration and how
often an unseen scan finds its own place among those of all unseen scans.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from learned.matcher import load_matcher
from learned.place_embedding import PlaceEmbedding, similarities
from learned.place_training import PlacePairs, PlaceTraining, pairs_of, train_places
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatch
from learned.samples import Sample
from learned.training import make_folder
from sequences.held_out import validation_settings
from sequences.train_command import find_extract
from sequences.train_config import TrainConfig, read_config
from sequences.training_data import SimulatedSamples

RECALL_AMONG = (1, 5, 10)
_HEADINGS = 72
_JITTER_M = 3.0
"""Places of an index are metres apart, and a scan is taken between them."""
_VALIDATION_STREAM = 1
_STRIDE = 4  # neighbours in an area are of one street, often

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """How to train an embedding.

    Attributes
    ----------
    matcher
        Whose features are embedded: rotmatch (shipped) or a checkpoint of it.
    scans_per_area
        Of each neighbourhood that CONFIG simulates, so many scans are used.
    cache_dir
        Where simulated samples are kept, shared with `skyfix train`; None: beside the file.
    training
        Size, steps, batch, rate and seed.
    harmonics
        What is embedded.
    """

    matcher: str = "rotmatch"
    scans_per_area: int = 4
    cache_dir: Path | None = None
    training: PlaceTraining = field(default_factory=PlaceTraining)
    harmonics: RingHarmonics = field(default_factory=RingHarmonics)

    def __post_init__(self) -> None:
        if self.scans_per_area < 1:
            raise SkyfixError(f"--scans-per-area: expected 1 or more, got {self.scans_per_area}")


def train_embedding(
    config_path: Path, data_dir: Path, out: Path, options: PlaceOptions | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Train an embedding and write it.

    Parameters
    ----------
    config_path
        Of a training, see `sequences.train_config`: what it simulates is used, and has to reach as far as the rings.
    data_dir
        Folder that the extracts' paths are relative to.
    out
        File to write, .safetensors.
    options
        See `PlaceOptions`.
    progress
        Told how many of so many scans have been simulated and looked at.

    Returns
    -------
    What FILE.json holds.

    Raises
    ------
    SkyfixError
        If the configuration does not fit, the matcher is no RotMatch, or the file cannot be written.
    """
    options = options or PlaceOptions()
    config = read_config(config_path)
    harmonics, reach_m = options.harmonics, config.simulation.bev_half_extent_m
    if reach_m != harmonics.reach_m:
        raise SkyfixError(
            f"config {config_path.name}: expected scans simulated to {harmonics.reach_m:g} m, got {reach_m:g} m"
        )
    if out.suffix != ".safetensors":
        raise SkyfixError(f"--out: expected a file ending in .safetensors, got {out.name}")
    matcher = load_matcher(options.matcher)
    if not isinstance(matcher, RotMatch):
        raise SkyfixError(f"--matcher: expected rotmatch or a checkpoint of it, got {options.matcher}")
    make_folder(out.parent)
    training, validation = _pairs(matcher, config, data_dir, out, options, progress)
    embedding = train_places(matcher.net, training, harmonics, options.training)
    facts = {
        "architecture": "place-embedding-1",
        "command": f"skyfix train-places {config_path.name} --matcher {Path(options.matcher).name} "
        f"--scans-per-area {options.scans_per_area}",
        "network": embedding.network,
        "samples": len(training.yaws),
        "settings": asdict(options.training),
        "validation": recall_among(embedding, validation),
        "config": config.model_dump(mode="json"),
    }
    _write(embedding, facts, out)
    return facts


def recall_among(embedding: PlaceEmbedding, pairs: PlacePairs) -> dict[str, Any]:
    """How often a scan's own place is the best, or one of the best, of those of all the pairs.

    Returns
    -------
    `places`; `recall`: {"1", "5", "10"}, shares; `prior`: the same for places in any order.
    """
    scans, places = embedding.of_scans(pairs.scans), embedding.of_places(pairs.places)
    count = len(scans)
    scores = torch.stack([similarities(scan, places, _HEADINGS).amax(dim=1) for scan in scans])
    better = (scores > scores.diagonal()[:, None]).sum(dim=1)
    return {
        "places": count,
        "recall": {str(k): round(float((better < k).double().mean()), 3) for k in RECALL_AMONG},
        "prior": {str(k): round(min(1.0, k / count), 3) for k in RECALL_AMONG},
    }


def _pairs(
    matcher: RotMatch,
    config: TrainConfig,
    data_dir: Path,
    out: Path,
    options: PlaceOptions,
    progress: Progress | None,
) -> tuple[PlacePairs, PlacePairs]:
    """Pairs to train on, and others of the extract that is not trained on."""
    cache_dir = options.cache_dir or out.parent / "cache"
    extracts = [(find_extract(name, data_dir), weight) for name, weight in config.extracts.items()]
    source = SimulatedSamples(extracts, config.simulation, cache_dir / "training")
    held_out = [(find_extract(config.validation_extract, data_dir), 1.0)]
    unseen = SimulatedSamples(held_out, validation_settings(config), cache_dir / "validation")
    total = options.scans_per_area * source.areas + len(unseen)
    seed, told = options.training.seed, progress or (lambda done, total: None)

    def counted(samples: Iterator[tuple[Sample, FloatArray]], before: int) -> Iterator[tuple[Sample, FloatArray]]:
        for number, sample in enumerate(samples, start=before + 1):
            yield sample
            told(number, total)

    shown = counted(_displaced(source, options.scans_per_area, seed), 0)
    training = pairs_of(matcher.net, shown, options.harmonics)
    rng = np.random.default_rng((seed, _VALIDATION_STREAM))
    fresh = ((unseen[index], rng.uniform(-_JITTER_M, _JITTER_M, 2)) for index in range(len(unseen)))
    return training, pairs_of(matcher.net, counted(fresh, total - len(unseen)), options.harmonics)


def _displaced(source: SimulatedSamples, scans_per_area: int, seed: int) -> Iterator[tuple[Sample, FloatArray]]:
    """Samples, another of each neighbourhood in every round, and how far the places shown with them lie away."""
    for turn in range(scans_per_area):
        for area in range(source.areas):
            samples = source.area(area)
            offset = np.random.default_rng((seed, turn, area)).uniform(-_JITTER_M, _JITTER_M, 2)
            before_repeating = len(samples) // math.gcd(len(samples), _STRIDE)
            yield samples[(_STRIDE * turn + turn // before_repeating + area) % len(samples)], offset


def _write(embedding: PlaceEmbedding, facts: dict[str, Any], out: Path) -> None:
    partial, told = out.with_suffix(".part"), out.with_suffix(".json.part")
    embedding.save(partial)
    try:
        told.write_text(json.dumps(facts, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        told.replace(out.with_suffix(".json"))
        partial.replace(out)
    except OSError as error:
        raise SkyfixError(f"{out}: cannot be written: {error.strerror}") from error
