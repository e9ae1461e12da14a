"""A few measured frames kept whole for the report."""

from __future__ import annotations

from fusion.arrays import FloatArray
from learned.bev import BevSettings, bev_counts, log_density
from learned.map_raster import MapRaster
from sequences.measurement import Measurement
from sequences.run_result import Snapshot

_MAP_MARGIN_M = 30.0


def take_snapshot(
    index: int,
    measurement: Measurement,
    map_raster: MapRaster,
    ground_z: float,
    estimate: FloatArray,
    truth: FloatArray | None,
) -> Snapshot:
    """Keep the scan from above, the map around the search and the likelihood's highest value over the headings.

    Parameters
    ----------
    index
        Of the scan in the sequence.
    measurement
        The frame's measurement.
    map_raster, ground_z
        The map; the ground's height in the scan frame, metres.
    estimate, truth
        Poses (3,): the filter's after the measurement, the true one or None.
    """
    search = measurement.search
    window = map_raster.grid.window(search.centre[:2], search.half_extent_m + _MAP_MARGIN_M)
    return Snapshot(
        index=index,
        bev=log_density(bev_counts(measurement.points, ground_z, BevSettings())),
        map_crop=map_raster.crop(window),
        heat=measurement.heat(),
        heat_grid=measurement.likelihood.grid,
        truth=truth,
        estimate=estimate,
        best=measurement.best_pose(),
    )
