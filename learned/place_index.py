"""An index of the places of one map: what each looks like, to be compared with a scan at all headings at once.

The map is cut into tiles, and every few metres along its roads into places. The index holds an embedding of each place
(`learned.place_embedding`) and the map's features. A lookup takes four steps: all places are compared by their
embeddings; the likest are weighed by the vote of the scan's features about each on coarse cells (`learned.place_vote`),
less its mean over the headings, since what a place gets whatever the heading is its own, more in a dense town than in a
thin one, and says nothing of the scan; the best of these by the whole vote at finer headings, the embedding's score
added to both; and the best place of each leading tile by the vote on the features' own cells, about the heading found.

The comparison of embeddings is a product over all places and orders, then a Fourier sum over headings: exact, linear in
the length of the map's roads, and far below the cost of the vote, which is the same however large the map. So no
nearest-neighbour graph (usearch, faiss): it takes one vector a heading, 72 lookups a scan for an approximate answer,
and would save what is hardly spent.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from fusion import se2
from fusion.arrays import Float32Array, FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.damaged_files import UNREADABLE
from learned.place_embedding import similarities
from learned.place_vote import best_votes, vote_at

HEADINGS = 72
"""5 degrees apart: order 16 turns once in 22.5 degrees, and 10 would step over its peaks."""
_NATS = np.float32(20.0)
"""What a cosine of 1 is worth over one of 0: chosen with simulated scans of Helsinki in view."""
_CLOSELY, _FINER = 96, 3
"""So many places are voted on at so many headings a bin."""
_SHARPLY = 80
_SHARP_YAWS = np.radians(np.arange(-3.0, 4.0))
"""So many tiles' best places are voted on at such headings about the one found, on the features' own cells."""
VOTE_CELLS = 2
"""Feature cells on a side of one of the coarse vote's."""
_FEATURE_SCALE = 127.0
"""Features are unit vectors and kept as bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class Retrieved:
    """Tiles that a scan may have been taken in, the likeliest first.

    Attributes
    ----------
    centres
        (k, 2) of the tiles, metres in the map frame.
    poses
        (k, 3) the best pose found in each: metres, radians.
    scores
        (k,) of the best places, nats.
    place_scores
        (N, headings) of all places, nats, in the index's order; yaw of column j is 2 pi j / headings.
    """

    centres: FloatArray
    poses: FloatArray
    scores: FloatArray
    place_scores: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class PlaceIndex:
    """Places of one map.

    Attributes
    ----------
    grid
        Square cells over the map; a place is the middle of one.
    cells
        (N, 2) row and column of the places.
    embeddings
        (N, M + 1, D) complex64.
    features
        (C, H, W) int8, 127 times those of the map, from the grid's upper left corner on.
    feature_m
        Side of their cells, metres; twice that divides the side of the grid's cells.
    tile_cells
        Cells on a side of a tile; tiles are counted from the map's upper left corner.
    temperature
        What votes are divided by to be nats.
    fingerprint
        Of the weights of the network and the embedding that made it.
    map_digest
        Of the map.
    coarse
        (C, H / 2, W / 2) float16: the features averaged over the coarse vote's cells; made, not given.
    """

    grid: MapGrid
    cells: IntArray
    embeddings: Tensor
    features: Tensor
    feature_m: float
    tile_cells: int
    temperature: float
    fingerprint: str
    map_digest: str
    coarse: Tensor = field(init=False)

    def __post_init__(self) -> None:
        pooled = functional.avg_pool2d(self.features.float() / _FEATURE_SCALE, VOTE_CELLS).half()
        object.__setattr__(self, "coarse", pooled)

    @staticmethod
    def kept(features: Tensor) -> Tensor:
        """A map's features (C, H, W), unit vectors, as an index keeps them."""
        return (features * _FEATURE_SCALE).round().to(torch.int8)

    @property
    def tiles(self) -> int:
        """Number of tiles that hold a place."""
        return len(np.unique(self.cells // self.tile_cells, axis=0))

    def similarities(self, embedding: Tensor) -> Float32Array:
        """Cosines (N, HEADINGS) of a scan's embedding (M + 1, D) with all places.

        Raises
        ------
        SkyfixError
            If the embedding is of another size.
        """
        if embedding.shape != self.embeddings.shape[1:]:
            expected = tuple(self.embeddings.shape[1:])
            raise SkyfixError(f"scan embedding: expected {expected}, got {tuple(embedding.shape)}")
        return np.asarray(similarities(embedding, self.embeddings, HEADINGS).numpy(), np.float32)

    def query(self, embedding: Tensor, scan: Tensor, k: int = 10, shortlist: int = 1000) -> Retrieved:
        """The `k` best tiles for a scan, fewer where the map has fewer.

        Parameters
        ----------
        embedding, scan
            (M + 1, D) of the scan; (C, n, n) its features, n a multiple of 4.
        shortlist
            So many places whose embeddings are the likest are voted on; no other counts as better than the worst.

        Raises
        ------
        SkyfixError
            If `k` or `shortlist` is not a positive whole number, or the embedding is of another size.
        """
        if not all(isinstance(count, int | np.integer) and count >= 1 for count in (k, shortlist)):
            raise SkyfixError(f"retrieval: expected whole k and shortlist of 1 or more, got {k} and {shortlist}")
        cosines = self.similarities(embedding)
        alike = _NATS * cosines.max(axis=1, keepdims=True)
        likest = np.argsort(-alike[:, 0], kind="stable")[:shortlist]
        # A coarse cell stands for all the scan's cells in it: their sum, not their mean.
        summed = functional.avg_pool2d(scan, VOTE_CELLS) * VOTE_CELLS**2
        votes = self._votes(summed, likest, 1)
        votes += alike[likest] - votes.mean(axis=1, keepdims=True)
        scores = _with_better(_NATS * cosines, likest, votes)
        closest = likest[np.argsort(-votes.max(axis=1), kind="stable")[:_CLOSELY]]
        scores = _with_better(scores, closest, self._votes(summed, closest, _FINER) + alike[closest])
        best = scores.max(axis=1)
        tiles = self.cells // self.tile_cells
        order = np.argsort(-best, kind="stable")
        _, first = np.unique(tiles[order], axis=0, return_index=True)
        chosen = order[np.sort(first)]  # the best place of each tile, the likeliest first
        sharp, others = chosen[:_SHARPLY], chosen[_SHARPLY:]
        votes, poses = self._sharp(scan, sharp, scores[sharp].argmax(axis=1))
        scores = _with_better(scores, sharp, scores[sharp] + (votes - best[sharp])[:, None])
        again = np.argsort(-votes, kind="stable")
        yaw = scores[others].argmax(axis=1) * (se2.TWO_PI / HEADINGS)
        unchanged = np.column_stack([self.grid.xy_from_pixel(self.cells[others] + 0.5), yaw])
        chosen, poses = np.concatenate([sharp[again], others])[:k], np.concatenate([poses[again], unchanged])[:k]
        poses[:, 2] = se2.wrap(poses[:, 2])
        centres = self.grid.xy_from_pixel((tiles[chosen] + 0.5) * self.tile_cells)
        return Retrieved(centres, poses, scores[chosen].max(axis=1).astype(np.float64), scores)

    def _sharp(self, scan: Tensor, places: IntArray, bins: IntArray) -> tuple[Float32Array, FloatArray]:
        """Votes (P,), nats, and poses (P, 3) of the best fit in places (P,) about heading bins (P,)."""
        per_cell = round(self.grid.metres_per_pixel / self.feature_m)
        yaws = (bins * (se2.TWO_PI / HEADINGS))[:, None] + _SHARP_YAWS
        found = best_votes(self.features, scan / _FEATURE_SCALE, self.cells[places] * per_cell, per_cell, yaws)
        yaw = np.take_along_axis(yaws, found.headings[:, None], axis=1)
        poses = np.column_stack([self.grid.xy_from_pixel(found.corners / per_cell), yaw])
        return np.asarray(found.votes / self.temperature, np.float32), poses

    def _votes(self, scan: Tensor, places: IntArray, finer: int) -> Float32Array:
        """Best votes (P, HEADINGS) at places (P,), nats; of so many headings in each bin, an odd number."""
        per_cell = round(self.grid.metres_per_pixel / (VOTE_CELLS * self.feature_m))
        votes = vote_at(self.coarse, scan, self.cells[places] * per_cell, per_cell, finer * HEADINGS)
        binned = np.roll(votes, finer // 2, axis=1).reshape(len(places), HEADINGS, finer)
        return np.asarray(binned.max(axis=2) / self.temperature, np.float32)

    def likelihood(self, found: Retrieved) -> LikelihoodVolume:
        """What an answer of this index says about the pose: a density over the places, to draw particles from.

        It is sharper than an answer is right, for vote and embedding are of one scan: weigh what is drawn from it by a
        matcher's likelihood, as `sequences.start_cloud` does with what it draws.
        """
        plan = (self.grid.rows, self.grid.cols)
        scores = np.zeros((*plan, found.place_scores.shape[1]), np.float32)
        scores[tuple(self.cells.T)] = found.place_scores
        valid = np.zeros((*plan, 1), np.bool_)
        valid[tuple(self.cells.T)] = True
        return LikelihoodVolume.from_scores(scores, self.grid, valid=valid)

    def save(self, path: Path) -> None:
        """Write PATH (.npz).

        Raises
        ------
        SkyfixError
            If it cannot be written.
        """
        grid = self.grid
        place = np.array([grid.rows, grid.cols, grid.metres_per_pixel, grid.x0, grid.y0], np.float64)
        partial = path.with_suffix(".part")
        try:
            with partial.open("wb") as file:
                np.savez(
                    file,
                    grid=place,
                    cells=self.cells,
                    embeddings=torch.view_as_real(self.embeddings).half().numpy(),
                    features=self.features.numpy(),
                    feature_m=self.feature_m,
                    tile_cells=self.tile_cells,
                    temperature=self.temperature,
                    fingerprint=self.fingerprint,
                    map_digest=self.map_digest,
                )
            partial.replace(path)
        except OSError as error:
            raise SkyfixError(f"index {path}: cannot be written: {error.strerror}") from error

    @classmethod
    def load(cls, path: Path) -> PlaceIndex:
        """Read what `save` wrote.

        Raises
        ------
        SkyfixError
            If the file is missing or something else.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                rows, cols, step, x0, y0 = data["grid"].tolist()
                embeddings = np.asarray(data["embeddings"], np.float32)
                read = cls(
                    MapGrid(int(rows), int(cols), step, x0, y0),
                    np.asarray(data["cells"], np.int64),
                    torch.view_as_complex(torch.from_numpy(embeddings)),
                    torch.from_numpy(_as_bytes(data["features"])),
                    float(data["feature_m"]),
                    int(data["tile_cells"]),
                    float(data["temperature"]),
                    str(data["fingerprint"]),
                    str(data["map_digest"]),
                )
                read._check()
        except (SkyfixError, *UNREADABLE) as error:
            what = next(iter(str(error).splitlines()), type(error).__name__)
            raise SkyfixError(f"index {path.name}: expected a file that PlaceIndex.save wrote, got: {what}") from error
        return read

    def _check(self) -> None:
        """Raise ValueError unless the parts fit each other."""
        cells, plan = self.cells, (self.grid.rows, self.grid.cols)
        if cells.ndim != 2 or cells.shape[1] != 2 or not len(cells) or (cells < 0).any() or (cells >= plan).any():
            raise ValueError(f"cells {cells.shape} that are not all within {plan[0]} x {plan[1]}")
        if self.embeddings.ndim != 3 or len(self.embeddings) != len(cells) or not self.embeddings.numel():
            raise ValueError(f"embeddings {tuple(self.embeddings.shape)} of {len(cells)} places")
        if not torch.view_as_real(self.embeddings).isfinite().all():
            raise ValueError("embeddings that are not finite")
        per_cell = self.grid.metres_per_pixel / (VOTE_CELLS * self.feature_m) if self.feature_m > 0.0 else 0.0
        if not (1.0 - 1e-9 < per_cell < np.inf and abs(per_cell - round(per_cell)) < 1e-9):
            raise ValueError(f"features on {self.feature_m} m for cells of {self.grid.metres_per_pixel} m")
        if self.tile_cells < 1 or not 0.0 < self.temperature < np.inf:
            raise ValueError(f"tiles of {self.tile_cells} cells and a temperature of {self.temperature}")


def _as_bytes(features: NDArray[np.generic]) -> NDArray[np.int8]:
    """Features as they are kept; ValueError for any others."""
    if features.dtype != np.int8 or features.ndim != 3 or not features.size:
        raise ValueError(f"features {features.shape} {features.dtype}")
    return np.asarray(features, np.int8)


def _with_better(scores: Float32Array, chosen: IntArray, better: Float32Array) -> Float32Array:
    """Scores (N, headings) with those of some places (P,) replaced; the others' best is then the worst of these."""
    others = np.ones(len(scores), np.bool_)
    others[chosen] = False
    highest = scores[others].max() if others.any() else np.float32(0.0)
    result = scores + (better.max(axis=1).min() - highest)
    result[chosen] = better
    return result
