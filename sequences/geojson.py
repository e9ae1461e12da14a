"""A run's trajectories by longitude and latitude, to be laid over any map: GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from pathlib import Path

from pyproj.enums import TransformDirection

from fusion.trajectory import Trajectory
from sequences.osm import local_projection
from sequences.run_result import RunResult
from sequences.sequence import odometry_is_emulated

_DIGITS = 8  # of a degree: a millimetre


def write_geojson(result: RunResult, origin_lat_lon: tuple[float, float], path: Path) -> None:
    """Write a line for each of the truth, odometry alone, filter and smoother.

    Parameters
    ----------
    result
        The run.
    origin_lat_lon
        Of its map frame, degrees.
    path
        The file.
    """
    lines = {"truth": result.truth, "odometry": result.odometry, "filter": result.filter, "smoother": result.smoother}
    features = [_line(name, line, origin_lat_lon) for name, line in lines.items() if line is not None]
    content = {
        "type": "FeatureCollection",
        "odometry": result.odometry_source,
        "odometry_emulated": odometry_is_emulated(result.odometry_source),
        "scans_simulated": result.scans_simulated,
        "features": features,
    }
    path.write_text(json.dumps(content) + "\n", encoding="utf-8")


def _line(name: str, trajectory: Trajectory, origin_lat_lon: tuple[float, float]) -> dict[str, object]:
    x, y = trajectory.poses[:, 0], trajectory.poses[:, 1]
    lon, lat = local_projection(origin_lat_lon).transform(x, y, direction=TransformDirection.INVERSE)
    places = [[round(float(a), _DIGITS), round(float(b), _DIGITS)] for a, b in zip(lon, lat, strict=True)]
    geometry = {"type": "LineString", "coordinates": places if len(places) > 1 else places * 2}
    return {"type": "Feature", "properties": {"name": name}, "geometry": geometry}
