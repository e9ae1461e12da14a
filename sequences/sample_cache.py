"""The stamp of a sample cache: how its samples were made, so that runs share a cache and never mix two."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.errors import SkyfixError
from sequences.osm import MapFeatures

_STAMP_FILE = "made_with.json"


def features_digest(features: MapFeatures) -> str:
    """What an extract holds, as a short hash; the file's name does not matter."""
    digest = hashlib.sha256()
    for area in features.areas:
        digest.update(f"{area.kind} {area.height_m}".encode())
        digest.update(b"".join(np.ascontiguousarray(ring).tobytes() for ring in area.rings))
    for line in features.lines:
        digest.update(
            f"{line.kind} {line.detail} {line.width_m}".encode() + np.ascontiguousarray(line.points).tobytes()
        )
    for kind, xy in features.points:
        digest.update(kind.encode() + np.ascontiguousarray(xy).tobytes())
    return digest.hexdigest()[:16]


def claim_cache(folder: Path, extracts: Sequence[tuple[MapFeatures, float]], settings: dict[str, object]) -> None:
    """Make a cache folder, or check that the one there is of the same samples.

    Parameters
    ----------
    folder
        The cache.
    extracts
        (features, weight) that neighbourhoods are drawn from.
    settings
        How each sample is made.

    Raises
    ------
    SkyfixError
        If the folder holds samples that were made otherwise, or cannot be written.
    """
    sources = [{"digest": features_digest(features), "weight": weight} for features, weight in extracts]
    stamp = json.loads(json.dumps({**settings, "extracts": sources}))
    path = folder / _STAMP_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if any(folder.glob("area_*.npz")):
                raise SkyfixError(
                    f"cache {folder}: holds samples but no {_STAMP_FILE} to say how they were made; choose another"
                )
            partial = path.with_suffix(f".{os.getpid()}.part")
            partial.write_text(json.dumps(stamp, indent=2) + "\n", encoding="utf-8")
            partial.replace(path)
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SkyfixError(f"cache {folder}: cannot be used: {error.strerror}") from error
    except ValueError as error:
        raise SkyfixError(f"cache {folder}: expected JSON in {_STAMP_FILE}, got {error}") from error
    for key in stamp | found:
        if found.get(key) != stamp.get(key):
            raise SkyfixError(
                f"cache {folder}: its samples were made with {key} {found.get(key)}, these need {stamp.get(key)}; "
                "choose another folder"
            )
