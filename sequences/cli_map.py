"""The command `skyfix map`; `sequences.cli` lists it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_LatLon = tuple[float, float]


def draw_map(
    extract: Annotated[
        Path, typer.Argument(help="OpenStreetMap extract: .osm.pbf, .osm.gz or .osm.", metavar="EXTRACT")
    ],
    target: Annotated[
        Path, typer.Argument(help="Folder of a drive, or a new one; gets map.json and map.png.", metavar="DIR")
    ],
    origin: Annotated[
        _LatLon | None,
        typer.Option(
            help="Where x and y are zero: latitude and longitude, degrees. Default: the middle of the extract.",
            metavar="LAT LON",
        ),
    ] = None,
    half_extent: Annotated[
        float | None,
        typer.Option(help="Draw a square of this half side about the origin, metres. Default: all of it.", metavar="M"),
    ] = None,
    metres_per_pixel: Annotated[float, typer.Option(help="Side of a pixel; matching works at 0.5.", metavar="M")] = 0.5,
    place: Annotated[
        _LatLon | None,
        typer.Option(help="Also say where this is on the map, for track --start.", metavar="LAT LON"),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the map that is there.")] = False,
) -> None:
    """Draw the map of a drive of your own from an OpenStreetMap extract.

    The map frame has x to the east and y to the north, metres. map_preview.png shows what was drawn.
    """
    from sequences.extract_map import (
        MapRequest,
        checked_lat_lon,
        local_xy,
        map_of_extract,
        shares,
        write_extract_map,
    )

    if place is not None:
        checked_lat_lon("place", place)
    drawn = map_of_extract(extract, MapRequest(origin, half_extent, metres_per_pixel))
    write_extract_map(target, drawn, overwrite)
    grid, (lat, lon) = drawn.raster.grid, drawn.origin_lat_lon
    covered = ", ".join(f"{share:.0%} {kind}" for kind, share in shares(drawn).items())
    typer.echo(f"{target}: {grid.width_m:.0f} x {grid.height_m:.0f} m, origin at {lat:.6f} {lon:.6f}; {covered}")
    if shares(drawn)["building"] < 0.01:
        typer.echo("hardly any buildings, which scans are matched with above all")
    if place is not None:
        x, y = local_xy(drawn.origin_lat_lon, place)
        where = "" if grid.contains((x, y)) else ", which is not on the map"
        typer.echo(f"{place[0]:.6f} {place[1]:.6f} is at x {x:.1f} y {y:.1f}{where}")
