"""A drive's scans looked up in an index of its map, and how often the right tile is among the answers."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.place_index import PlaceIndex
from learned.retrieval import Retriever, map_digest
from sequences.drive import STAMP_TOLERANCE_NS
from sequences.sequence import ScanError, Sequence

RECALL_AT = (1, 5, 10, 50, 100)


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


@dataclass(frozen=True, slots=True)
class LookedUp:
    """The best tiles for one scan.

    Attributes
    ----------
    frame, stamp_ns
        Of the scan.
    centres, poses, scores
        (k, 2), (k, 3) and (k,), as in `learned.place_index.Retrieved`.
    seconds
        That it took.
    """

    frame: int
    stamp_ns: int
    centres: FloatArray
    poses: FloatArray
    scores: FloatArray
    seconds: float


def look_up(
    sequence: Sequence, retriever: Retriever, index: PlaceIndex, max_frames: int = 200, shortlist: int = 1000
) -> list[LookedUp]:
    """The best 100 tiles for scans of a drive, of those with ground truth where there is any; none for unusable scans.

    Raises
    ------
    SkyfixError
        If no scan can be used.
    """
    stamps, truth = sequence.stamps_ns, sequence.ground_truth
    frames = np.arange(len(stamps))
    if truth is not None:
        first, last = truth.span_ns
        frames = np.flatnonzero((stamps >= first - STAMP_TOLERANCE_NS) & (stamps <= last + STAMP_TOLERANCE_NS))
    most = min(max_frames, len(frames))
    answers = []
    for frame in frames[np.linspace(0, len(frames) - 1, most).round().astype(int)] if most else ():
        try:
            points = sequence.scan(int(frame))
        except ScanError:
            continue
        began = time.perf_counter()
        found = retriever.query(index, points, sequence.ground_z, k=max(RECALL_AT), shortlist=shortlist)
        seconds = time.perf_counter() - began
        answers.append(LookedUp(int(frame), int(stamps[frame]), found.centres, found.poses, found.scores, seconds))
    if not answers:
        known = "" if truth is None else " with ground truth"
        raise SkyfixError(f"{sequence.name}: expected a usable scan{known}, got none in {len(frames)}")
    return answers


def summary_of(sequence: Sequence, index: PlaceIndex, answers: list[LookedUp]) -> dict[str, Any]:
    """What was looked up where, and the recall of the tile that holds the true position.

    Returns
    -------
    `sequence`, `scans_simulated`, `frames`, `tiles`, `places`, `seconds_per_scan`, and `recall`: {"1", "5", "10", "50",
    "100"} fractions, None without ground truth.
    """
    return {
        "sequence": sequence.name,
        "scans_simulated": sequence.scans_simulated,
        "frames": len(answers),
        "tiles": index.tiles,
        "places": len(index.cells),
        "recall": None if sequence.ground_truth is None else _recall(sequence.ground_truth, index, answers),
        "seconds_per_scan": sum(answer.seconds for answer in answers) / len(answers),
    }


def _recall(truth: Trajectory, index: PlaceIndex, answers: list[LookedUp]) -> dict[str, float]:
    half = 0.5 * index.tile_cells * index.grid.metres_per_pixel
    ranks = []
    for answer in answers:
        pose = truth.interpolate(np.array([answer.stamp_ns]), STAMP_TOLERANCE_NS)[0]
        right = np.flatnonzero((np.abs(answer.centres - pose[:2]) <= half).all(axis=1))
        ranks.append(int(right[0]) if len(right) else len(answer.centres) + max(RECALL_AT))
    return {str(k): float(np.mean(np.array(ranks) < k)) for k in RECALL_AT}


def places_csv(answers: list[LookedUp], most: int) -> str:
    """The best tiles of each scan, the best first: the pose in each that fits best, in the map's frame."""
    lines = ["frame,stamp_s,rank,x_m,y_m,heading_deg,score_nats"]
    for answer in answers:
        for rank, ((x, y, yaw), score) in enumerate(zip(answer.poses[:most], answer.scores[:most], strict=True), 1):
            where = f"{x:.2f},{y:.2f},{math.degrees(yaw):.1f},{score:.2f}"
            lines.append(f"{answer.frame},{answer.stamp_ns * 1e-9:.9f},{rank},{where}")
    return "\n".join(lines) + "\n"


def summary_table(summary: dict[str, Any]) -> str:
    """What `summary_of` gives as Markdown, where there is a recall with the row of the prior: tiles taken at random."""
    scans = "simulated" if summary["scans_simulated"] else "real"
    among = f"{summary['tiles']} tiles ({summary['places']} places)"
    lines = [
        f"{summary['sequence']}: {summary['frames']} {scans} scans looked up among {among}",
        f"{summary['seconds_per_scan']:.2f} s a scan",
    ]
    recall = summary["recall"]
    if recall is not None:
        chance = {k: min(int(k) / summary["tiles"], 1.0) for k in recall}
        lines += ["", f"| right tile among the first | {' | '.join(recall)} |", f"|---|{'--:|' * len(recall)}"]
        for name, shares in (("prior", chance), ("retrieval", recall)):
            lines.append(f"| {name} | {' | '.join(f'{100 * share:.0f} %' for share in shares.values())} |")
    return "\n".join(lines) + "\n"
