"""A run's lines by longitude and latitude lie where the ellipsoid has the map frame's metres."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from made_drive import EmulatedMatcher, MadeDrive

import sequences.run_directory as run_directory
from fusion.errors import SkyfixError
from sequences.folder import FolderSequence, write_folder
from sequences.geojson import write_geojson
from sequences.localize import track
from sequences.map_source import MAP_FILE
from sequences.run_directory import write_run
from sequences.sequence import origin_of
from sequences.track_settings import TrackSettings

ORIGIN = (49.0116, 8.4169)


def georeferenced(made: MadeDrive, origin: object) -> Path:
    file = made.path / MAP_FILE
    file.write_text(json.dumps({**json.loads(file.read_text()), "origin_lat_lon_alt": origin}))
    return made.path


def test_lines_are_where_the_geodesic_has_them(
    made_drive: MadeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = FolderSequence(georeferenced(made_drive, [*ORIGIN, 112.0]))
    settings = TrackSettings("wheels", seed=3, particles=500)
    result = track(sequence, EmulatedMatcher(made_drive.truth.poses), settings)
    assert result.origin_lat_lon == origin_of(sequence) == ORIGIN
    monkeypatch.setattr(run_directory, "write_report", lambda result, out_dir: None)
    write_run(result, tmp_path / "run")
    content = json.loads((tmp_path / "run" / "trajectories.geojson").read_text())
    lines = {each["properties"]["name"]: np.array(each["geometry"]["coordinates"]) for each in content["features"]}
    told = {key: content[key] for key in ("odometry", "odometry_emulated", "scans_simulated")}
    assert told == {"odometry": "wheels", "odometry_emulated": False, "scans_simulated": sequence.scans_simulated}
    assert list(lines) == ["truth", "odometry", "filter", "smoother"]
    for name, line in lines.items():
        poses = getattr(result, name).poses
        azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(*np.tile(ORIGIN[::-1], (len(line), 1)).T, *line.T)
        east, north = distance * np.sin(np.radians(azimuth)), distance * np.cos(np.radians(azimuth))
        np.testing.assert_allclose(np.stack([east, north], axis=1), poses[:, :2], atol=0.01)
    unknown = replace(result, truth=None)
    write_geojson(unknown, ORIGIN, tmp_path / "lines.geojson")
    assert len(json.loads((tmp_path / "lines.geojson").read_text())["features"]) == 3


def test_a_converted_drive_keeps_its_origin(made_drive: MadeDrive, tmp_path: Path) -> None:
    write_folder(tmp_path / "copy", FolderSequence(georeferenced(made_drive, list(ORIGIN))))
    assert origin_of(FolderSequence(tmp_path / "copy")) == ORIGIN


def test_an_origin_may_be_unknown_but_not_nonsense(made_drive: MadeDrive) -> None:
    assert origin_of(FolderSequence(georeferenced(made_drive, None))) is None
    with pytest.raises(SkyfixError, match="origin_lat_lon_alt: expected two or three numbers, got 'here'"):
        FolderSequence(georeferenced(made_drive, "here"))
