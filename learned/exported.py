"""Matchers whose encoders run in another runtime than torch: made of a matcher at hand, or of an export folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fusion.errors import SkyfixError
from learned.backends import Backend, Session, first_installed
from learned.calibration import Calibration
from learned.export import FORMAT, GRAPHS, INDEX, encoder_graphs
from learned.rotmatch import ARCHITECTURE, STRIDE, RotMatch, RotMatchSettings
from learned.voting import vote
from learned.voting_net import VotingMatcher


class ExportedRotMatch:
    """RotMatch's encoders as sessions and its voting; implements `learned.voting_net.PoseScorer`.

    Parameters
    ----------
    settings
        Of the network that was exported.
    scan, picture
        Its encoders of scans and of pictures of the map.
    """

    stride = STRIDE

    def __init__(self, settings: RotMatchSettings, scan: Session, picture: Session) -> None:
        self.settings, self._scan, self._picture = settings, scan, picture

    def eval(self) -> ExportedRotMatch:
        """Itself: it was exported in evaluation mode."""
        return self

    def scan_features(self, density: Tensor) -> Tensor:
        """See `RotMatchNet.scan_features`."""
        return _run(self._scan, density)

    def map_features(self, picture: Tensor) -> Tensor:
        """See `RotMatchNet.map_features`."""
        return _run(self._picture, picture)

    def pose_scores(self, density: Tensor, picture: Tensor, yaws: Tensor) -> Tensor:
        """See `PoseScorer.pose_scores`."""
        return vote(self.map_features(picture[None])[0], self.scan_features(density[None])[0], yaws)


def _run(session: Session, image: Tensor) -> Tensor:
    (features,) = session.run(image.numpy())
    if not np.isfinite(features).all():
        raise SkyfixError("exported encoder: expected finite features, got NaN or an infinity")
    return torch.from_numpy(features)


def exported_matcher(
    settings: RotMatchSettings, calibration: Calibration, graphs: Mapping[str, bytes], backend: Backend
) -> VotingMatcher[ExportedRotMatch]:
    """A matcher "rotmatch-BACKEND" of graphs as `encoder_graphs` makes them."""
    scan, picture = (backend.session(graphs[name]) for name in GRAPHS)
    return VotingMatcher(f"rotmatch-{backend.name}", ExportedRotMatch(settings, scan, picture), calibration)


def with_backend(matcher: object, backend: Backend) -> VotingMatcher[ExportedRotMatch]:
    """The same matcher with its encoders in another runtime.

    Raises
    ------
    SkyfixError
        If the matcher is no RotMatch, the runtime is missing, or it wants 8-bit graphs, which need calibration.
    """
    if not isinstance(matcher, RotMatch):
        name = getattr(matcher, "name", type(matcher).__name__)
        raise SkyfixError(f"backend {backend.name}: expected rotmatch or a checkpoint of it, got {name}")
    if backend.weights != "fp32":
        raise SkyfixError(f"backend {backend.name}: expected a folder of `skyfix export --int8`, got {matcher.name}")
    return exported_matcher(matcher.net.settings, matcher.calibration, encoder_graphs(matcher.net), backend)


def load_exported(folder: Path, backend: Backend | None = None) -> VotingMatcher[ExportedRotMatch]:
    """Open an export folder (see `learned.export`); None: the first runtime that is installed.

    Raises
    ------
    SkyfixError
        If a file is missing or unreadable, the folder is of another version, or the runtime is missing.
    """
    backend = backend or first_installed()
    facts = _facts(folder)
    try:
        if (facts["format"], facts["architecture"]) != (FORMAT, ARCHITECTURE.tag):
            got = f"{facts['format']} of {facts['architecture']}"
            raise SkyfixError(f"export {folder}: expected format {FORMAT} of {ARCHITECTURE.tag}, got {got}")
        settings, calibration = _settings(facts["settings"]), Calibration(**facts["calibration"])
        if backend.weights not in facts["graphs"]:
            kinds = ", ".join(facts["graphs"])
            raise SkyfixError(f"export {folder}: expected {backend.weights} graphs for {backend.name}, got {kinds}")
        graphs = {name: (folder / Path(facts["graphs"][backend.weights][name]).name).read_bytes() for name in GRAPHS}
    except OSError as error:
        raise SkyfixError(f"export {folder}: cannot be read: {error.strerror or error}") from error
    except (KeyError, TypeError) as error:
        raise SkyfixError(f"export {folder}: expected a readable {INDEX}, got {error!r}") from error
    return exported_matcher(settings, calibration, graphs, backend)


def _settings(content: Mapping[str, Any]) -> RotMatchSettings:
    from learned.architectures import settings_from

    settings = settings_from(ARCHITECTURE, content)
    assert isinstance(settings, RotMatchSettings)
    return settings


def _facts(folder: Path) -> dict[str, Any]:
    try:
        facts = json.loads((folder / INDEX).read_text(encoding="utf-8"))
    except OSError as error:
        raise SkyfixError(f"export {folder}: expected {INDEX} in it, got: {error.strerror or error}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise SkyfixError(f"export {folder}: expected a readable {INDEX}, got {error!r}") from error
    if not isinstance(facts, dict):
        raise SkyfixError(f"export {folder}: expected a JSON object in {INDEX}, got {type(facts).__name__}")
    return facts
