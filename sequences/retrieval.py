"""Place embeddings from simulated scans, and how often an index answers a drive's scans with the right tile."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from learned.place_embedding import PlaceEmbedding
from learned.place_index import PlaceIndex
from learned.place_training import PlaceTraining, pairs_of, train_places
from learned.retrieval import Retriever, map_digest
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatch
from learned.samples import Sample
from sequences.drive import STAMP_TOLERANCE_NS
from sequences.sequence import ScanError, Sequence
from sequences.train_command import find_extract
from sequences.train_config import read_config
from sequences.training_data import SimulatedSamples

RECALL_AT = (1, 5, 10, 50, 100)
_JITTER_M = 3.0
"""Places of an index are metres apart, and a scan is taken between them."""


def train_embedding(
    config: Path, data: Path, cache: Path, settings: PlaceTraining, scans_per_area: int
) -> PlaceEmbedding:
    """Train the embedding of the shipped RotMatch's features on the samples of a `skyfix train` configuration.

    Parameters
    ----------
    config
        Scans have to be simulated as far as the rings reach.
    data, cache
        Folders of the OpenStreetMap extracts and of the simulated samples.
    scans_per_area
        Of each neighbourhood, so many samples are used.
    """
    plan = read_config(config)
    harmonics = RingHarmonics()
    if plan.simulation.bev_half_extent_m != harmonics.reach_m:
        raise SkyfixError(
            f"config {config.name}: expected scans simulated to {harmonics.reach_m:g} m, "
            f"got {plan.simulation.bev_half_extent_m:g} m"
        )
    extracts = [(find_extract(name, data), weight) for name, weight in plan.extracts.items()]
    source = SimulatedSamples(extracts, plan.simulation, cache)
    net = RotMatch.shipped().net
    pairs = pairs_of(net, _displaced(source, scans_per_area, settings.seed), harmonics)
    return train_places(net, pairs, harmonics, settings)


def _displaced(source: SimulatedSamples, scans_per_area: int, seed: int) -> Iterator[tuple[Sample, FloatArray]]:
    """Samples, another of each neighbourhood in every round, and how far the places shown with them lie away."""
    for turn in range(scans_per_area):
        for area in range(source.areas):
            samples = source.area(area)
            offset = np.random.default_rng((seed, turn, area)).uniform(-_JITTER_M, _JITTER_M, 2)
            yield samples[(4 * turn + area) % len(samples)], offset


def index_of(sequence: Sequence, retriever: Retriever, path: Path | None) -> PlaceIndex:
    """The index of a drive's map: read from a file, or made and, where a file is named, written.

    Raises
    ------
    SkyfixError
        If the file is no index, or one of another map.
    """
    if path is None or not path.exists():
        index = retriever.build(sequence.map)
        if path is not None:
            index.save(path)
        return index
    index = PlaceIndex.load(path)
    if index.map_digest != map_digest(sequence.map):
        raise SkyfixError(f"index {path.name}: expected one of the map of {sequence.name}, got one of another map")
    return index


def score_retrieval(
    sequence: Sequence, retriever: Retriever, index: PlaceIndex, max_frames: int = 200, shortlist: int = 1000
) -> dict[str, Any]:
    """Recall of the tile that holds the true position, and seconds a scan.

    Returns
    -------
    `sequence`, `scans_simulated`, `frames`, `tiles`, `places`, `recall`: {"1", "5", "10", "50", "100"} fractions, and
    `seconds_per_scan`.

    Raises
    ------
    SkyfixError
        If there is no ground truth, or no scan can be used.
    """
    truth = sequence.ground_truth
    if truth is None:
        raise SkyfixError(f"{sequence.name}: expected ground truth to score retrieval against, found none")
    first, last = truth.span_ns
    stamps = sequence.stamps_ns
    covered = np.flatnonzero((stamps >= first - STAMP_TOLERANCE_NS) & (stamps <= last + STAMP_TOLERANCE_NS))
    most = min(max_frames, len(covered))
    ranks, seconds = [], 0.0
    for frame in covered[np.linspace(0, len(covered) - 1, most).round().astype(int)] if most else ():
        pose = truth.interpolate(stamps[[frame]], STAMP_TOLERANCE_NS)[0]
        try:
            points = sequence.scan(int(frame))
        except ScanError:
            continue
        began = time.perf_counter()
        found = retriever.query(index, points, sequence.ground_z, k=max(RECALL_AT), shortlist=shortlist)
        seconds += time.perf_counter() - began
        half = 0.5 * index.tile_cells * index.grid.metres_per_pixel
        right = np.flatnonzero((np.abs(found.centres - pose[:2]) <= half).all(axis=1))
        ranks.append(int(right[0]) if len(right) else len(found.centres) + max(RECALL_AT))
    if not ranks:
        raise SkyfixError(f"{sequence.name}: expected a usable scan with ground truth, got none in {len(covered)}")
    return {
        "sequence": sequence.name,
        "scans_simulated": sequence.scans_simulated,
        "frames": len(ranks),
        "tiles": index.tiles,
        "places": len(index.cells),
        "recall": {str(k): float(np.mean(np.array(ranks) < k)) for k in RECALL_AT},
        "seconds_per_scan": seconds / len(ranks),
    }


def recall_table(scores: dict[str, Any]) -> str:
    """What `score_retrieval` gives as Markdown, with the row of the prior: tiles taken at random."""
    scans = "simulated" if scores["scans_simulated"] else "real"
    chance = {k: min(int(k) / scores["tiles"], 1.0) for k in scores["recall"]}
    among = f"{scores['tiles']} tiles ({scores['places']} places)"
    lines = [
        f"{scores['sequence']}: {scores['frames']} {scans} scans looked up among {among}",
        f"{scores['seconds_per_scan']:.2f} s a scan",
        "",
        f"| right tile among the first | {' | '.join(scores['recall'])} |",
        f"|---|{'--:|' * len(scores['recall'])}",
    ]
    for name, shares in (("prior", chance), ("retrieval", scores["recall"])):
        lines.append(f"| {name} | {' | '.join(f'{100 * share:.0f} %' for share in shares.values())} |")
    return "\n".join(lines) + "\n"
