"""Simulated training samples from OpenStreetMap extracts, made once and cached.

Every area is a neighbourhood of an extract with a style, a sensor and a world of its own; several scans are taken in
each. A sample depends on the seed and its number alone, so the cache can be deleted, or made by several processes at
once.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.bev import BevSettings, GroundModel, bev_counts
from learned.damaged_files import UNREADABLE
from learned.samples import SAMPLE_METRES_PER_PIXEL, UNKNOWN_PLACE, Sample, cut_sample
from sequences.lidar import LidarModel, simulate_scan
from sequences.osm import MapFeatures
from sequences.sample_cache import claim_cache
from sequences.world import World, build_area, sample_road_poses
from sequences.world_overhead import drivable_map, overhead_map
from sequences.world_style import WorldStyle

_ATTEMPTS = 60
_AREAS_MIXED = 16
_NEWER = ("ground", "world", "sensor")
"""Settings that older caches do not name: left out of a cache's stamp where they are as they were then."""
_EXTRACTS_APART_M = 1e7
"""Every extract has a frame of its own; this puts places of different ones far apart."""


@dataclass(frozen=True, slots=True)
class SimulationSettings:
    """How samples are made.

    Attributes
    ----------
    samples, samples_per_area
        Number of samples in all and from each simulated neighbourhood.
    area_half_extent_m
        Half the side of a neighbourhood; scans are taken in its middle.
    scan_half_extent_m
        Half the side of the square in which scans are taken.
    sample_px
        Side of the class raster kept with a sample, pixels of 0.5 m.
    bev_half_extent_m
        Reach of the bird's-eye views; scans are cast half as far again, up to the sensor's range.
    azimuths
        Beams of one elevation per simulated revolution: drawn from this range for each area.
    least_buildings
        Neighbourhoods with fewer are passed over, nine times out of ten.
    overhead_share
        Share of neighbourhoods whose map is what an aerial image shows, segmented, instead of OpenStreetMap's.
    drivable_share
        Share of those whose map shows carriageways alone, with their full width.
    overgrown_share
        Share of neighbourhoods whose unpaved ground is mostly hedges and brushwood, which hide the houses.
    ground
        What the heights in the bird's-eye views are above, see `learned.bev`.
    world, sensor
        Properties that all neighbourhoods and all sensors have instead of what is drawn for each: of
        `sequences.world_style.WorldStyle` and of `sequences.lidar.LidarModel`.

    Raises
    ------
    SkyfixError
        If a world or a sensor has no such property, or a number is out of range.
    """

    samples: int = 16000
    samples_per_area: int = 16
    area_half_extent_m: float = 124.0
    scan_half_extent_m: float = 55.0
    sample_px: int = 336
    bev_half_extent_m: float = 40.0
    azimuths: tuple[int, int] = (900, 2000)
    least_buildings: int = 5
    overhead_share: float = 0.0
    drivable_share: float = 0.0
    overgrown_share: float = 0.0
    seed: int = 0
    ground: GroundModel = "surface"
    world: Mapping[str, float] = field(default_factory=dict)
    sensor: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.samples < 0:
            raise SkyfixError(f"simulation.samples: expected zero or more, got {self.samples}")
        for name in ("samples_per_area", "area_half_extent_m", "scan_half_extent_m", "sample_px"):
            if not getattr(self, name) > 0:
                raise SkyfixError(f"simulation.{name}: expected above zero, got {getattr(self, name)}")
        for name in ("overhead_share", "drivable_share", "overgrown_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SkyfixError(f"simulation.{name}: expected 0 to 1, got {getattr(self, name)}")
        for name, given, kind in (("world", self.world, WorldStyle), ("sensor", self.sensor, LidarModel)):
            known = {each.name for each in fields(kind) if each.type == "float"}
            for key in given.keys() - known:
                raise SkyfixError(f"simulation.{name}: expected one of {', '.join(sorted(known))}, got {key}")


class SimulatedSamples:
    """A sample source (`learned.training.SampleSource`) over simulated neighbourhoods of several extracts.

    Parameters
    ----------
    extracts
        (features, weight): neighbourhoods are drawn from extracts in proportion to their weights.
    settings
        How samples are made.
    cache_dir
        Where finished areas are kept. Runs with the same extracts and settings may share it, however many samples
        each takes; for others it is refused.

    Raises
    ------
    SkyfixError
        If there is no extract, or the cache holds samples made otherwise.
    """

    def __init__(
        self, extracts: Sequence[tuple[MapFeatures, float]], settings: SimulationSettings, cache_dir: Path
    ) -> None:
        if not extracts:
            raise SkyfixError("training data: expected at least one extract, got none")
        self.extracts = [features for features, _ in extracts]
        weights = np.array([weight for _, weight in extracts], dtype=np.float64)
        self.weights = weights / weights.sum()
        self.settings = settings
        self.cache_dir = cache_dir
        self._held: dict[int, list[Sample]] = {}
        how = asdict(settings)
        del how["samples"]
        unsaid = asdict(SimulationSettings())
        claim_cache(cache_dir, extracts, {key: how[key] for key in how if key not in _NEWER or how[key] != unsaid[key]})

    def __len__(self) -> int:
        return self.settings.samples

    def __getitem__(self, index: int) -> Sample:
        area, within = divmod(index, self.settings.samples_per_area)
        if area not in self._held:
            while len(self._held) >= _AREAS_MIXED:
                del self._held[next(iter(self._held))]
            self._held[area] = self.area(area)
        return self._held[area][within]

    def order(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """Indices of one epoch: areas shuffled, and samples shuffled among groups of neighbours in that order.

        Samples of one group are made or read together; a full shuffle would make an area for every sample.
        """
        per_area = self.settings.samples_per_area
        areas = rng.permutation(self.areas)
        groups = []
        for first in range(0, len(areas), _AREAS_MIXED):
            group = areas[first : first + _AREAS_MIXED, None] * per_area + np.arange(per_area)
            groups.append(rng.permutation(group.reshape(-1)))
        order = np.concatenate(groups)
        return order[order < len(self)]

    @property
    def areas(self) -> int:
        """Number of neighbourhoods that the samples are from."""
        return -(-len(self) // self.settings.samples_per_area)

    def missing_areas(self) -> list[int]:
        """Those that are not in the cache yet."""
        return [number for number in range(self.areas) if not self._path(number).exists()]

    def _path(self, number: int) -> Path:
        return self.cache_dir / f"area_{number:05d}.npz"

    def area(self, number: int) -> list[Sample]:
        """All samples of an area, from the cache or made now."""
        path = self._path(number)
        if path.exists() and (cached := _read_samples(path)) is not None:
            return cached
        samples = self._simulate(number)
        partial = path.with_suffix(f".{os.getpid()}.part.npz")
        np.savez_compressed(
            partial,
            counts=np.stack([s.counts for s in samples]),
            classes=np.stack([s.classes for s in samples]),
            poses=np.array([(s.row, s.col, s.yaw) for s in samples]),
            places=np.array([s.place for s in samples]),
        )
        partial.replace(path)
        return samples

    def _simulate(self, number: int) -> list[Sample]:
        settings = self.settings
        for attempt in range(_ATTEMPTS):
            rng = np.random.default_rng((settings.seed, number, attempt))
            extract = int(rng.choice(len(self.extracts), p=self.weights))
            features = self.extracts[extract]
            grid = _neighbourhood(features, settings.area_half_extent_m, rng)
            here = features.within(grid)
            if sum(area.kind == "building" for area in here.areas) < settings.least_buildings and rng.random() < 0.9:
                continue
            style = WorldStyle.random(rng)
            if settings.overgrown_share > 0 and rng.random() < settings.overgrown_share:
                style = replace(style, undergrowth=float(rng.uniform(0.4, 0.98)))
            style = replace(style, **dict[str, Any](settings.world))
            world, map_raster = build_area(features, grid, style, rng)
            if settings.overhead_share > 0 and rng.random() < settings.overhead_share:
                only_drivable = rng.random() < settings.drivable_share
                draw = drivable_map if only_drivable else overhead_map
                map_raster = draw(world, grid, style.map_offset_m, rng)
            margin = settings.area_half_extent_m - settings.scan_half_extent_m
            poses = sample_road_poses(world, settings.samples_per_area, rng, margin_m=margin)
            if len(poses) < settings.samples_per_area or map_raster.classes is None:
                continue
            azimuths = int(rng.integers(settings.azimuths[0], settings.azimuths[1] + 1))
            model = LidarModel.random(rng, azimuths)
            model = replace(model, **dict[str, Any](settings.sensor))
            model = replace(model, max_range_m=min(1.5 * settings.bev_half_extent_m, model.max_range_m))
            samples = [self._sample(pose, model, world, map_raster.classes, grid, rng) for pose in poses]
            places = [(float(pose[0]) + extract * _EXTRACTS_APART_M, float(pose[1])) for pose in poses]
            return [replace(sample, place=place) for sample, place in zip(samples, places, strict=True)]
        raise SkyfixError(f"training data: found no neighbourhood with roads and buildings in {_ATTEMPTS} attempts")

    def _sample(
        self,
        pose: NDArray[np.float64],
        model: LidarModel,
        world: World,
        classes: NDArray[np.uint8],
        grid: MapGrid,
        rng: np.random.Generator,
    ) -> Sample:
        scan = simulate_scan(world, pose, model, rng)
        row, col = grid.pixel_from_xy(pose[:2])
        bev = BevSettings(self.settings.bev_half_extent_m, ground=self.settings.ground)
        counts = bev_counts(scan, -model.mount_height_m, bev)
        return cut_sample(counts, classes, float(row), float(col), float(pose[2]), self.settings.sample_px)


def _read_samples(path: Path) -> list[Sample] | None:
    """The samples of a cached area; None when the file is damaged, and the area is to be made again."""
    try:
        with path.open("rb") as file, np.load(file) as data:
            poses = data["poses"].tolist()
            places = data["places"].tolist() if "places" in data else [UNKNOWN_PLACE] * len(poses)
            columns = zip(data["counts"], data["classes"], poses, places, strict=True)
            return [
                Sample(counts, classes, row, col, yaw, (x, y)) for counts, classes, (row, col, yaw), (x, y) in columns
            ]
    except UNREADABLE:
        return None


def _neighbourhood(features: MapFeatures, half_extent_m: float, rng: np.random.Generator) -> MapGrid:
    """A square about a random point of a random road, roads being drawn by length."""
    roads = features.roads()
    if not roads:
        raise SkyfixError("training data: expected an extract with roads, got none")
    lengths = np.array([np.hypot(*np.diff(road.points, axis=0).T).sum() for road in roads])
    road = roads[int(rng.choice(len(roads), p=lengths / lengths.sum()))]
    centre = road.points[int(rng.integers(len(road.points)))]
    size = 2 * round(half_extent_m / SAMPLE_METRES_PER_PIXEL)
    x0, y0 = centre - half_extent_m
    return MapGrid(size, size, SAMPLE_METRES_PER_PIXEL, float(x0), float(y0))
