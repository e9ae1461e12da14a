"""Worlds: what a map says stands where it says, what it does not say is added, and a seed decides all of it."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, MapRaster
from sequences import paint
from sequences.osm import Area, Line, MapFeatures, rasterise
from sequences.world import Material, World, WorldStyle, build_area, sample_road_poses, world_from_raster
from sequences.world_overhead import drivable_map, overhead_map

GRID = MapGrid(240, 240, 0.5, -60.0, -60.0)
BARE = WorldStyle(
    **{f.name: 0.0 for f in fields(WorldStyle)}
    | {"road_width_factor": 1.0, "forest_spacing_m": 5.0, "foliage_per_m": 1.0, "kerb_m": 0.1, "storeys": 3.0}
)


def box(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)


TOWN = MapFeatures(
    (
        Area("building", (box(10, 10, 30, 25),), 9.0, 300.0),
        Area("building", (box(-40, 12, -20, 30),), float("nan"), 360.0),
        Area("forest", (box(-50, -50, -20, -20),), size_m2=900.0),
        Area("parking", (box(20, -50, 50, -20),), size_m2=900.0),
    ),
    (
        Line("road", np.array([[-70.0, 0.0], [70.0, 0.0]]), 7.0, detail="residential"),
        Line("road", np.array([[0.0, -70.0], [0.0, 70.0]]), 6.0, detail="residential"),
        Line("wall", np.array([[30.0, 40.0], [50.0, 40.0]]), 0.0, 2.0, detail="wall"),
    ),
)


def height_at(world: World, x: float, y: float) -> float:
    cell = world.cells(np.array([x, y]))
    return float(world.surface[cell] - world.ground[cell])


def test_bare_world_is_its_map() -> None:
    world, map_raster = build_area(TOWN, GRID, BARE, np.random.default_rng(0))
    assert np.array_equal(map_raster.picture, rasterise(TOWN, GRID).picture)
    assert height_at(world, 20.0, 17.0) == pytest.approx(9.0)
    assert height_at(world, -30.0, 20.0) >= 3.0
    assert max(height_at(world, 40.0, y) for y in (39.8, 40.0, 40.2)) > 1.0
    for x, y in ((20.0, 0.0), (5.0, 20.0), (33.0, 17.0), (20.0, 8.0)):
        assert height_at(world, x, y) == 0.0


def test_kerb_steps_up_from_the_carriageway() -> None:
    world, _ = build_area(TOWN, GRID, BARE, np.random.default_rng(0))
    inside, outside = world.ground_at(np.array([[20.0, 3.2], [20.0, 4.0]]))
    assert outside - inside == pytest.approx(0.1, abs=0.03)
    middle, edge = world.ground_at(np.array([[20.0, 0.0], [20.0, 3.2]]))
    assert 0.03 < middle - edge < 0.1


def test_same_seed_same_world() -> None:
    style = WorldStyle.random(np.random.default_rng(5))
    assert style == WorldStyle.random(np.random.default_rng(5))
    (one, map_one), (same, map_same), (other, _) = (
        build_area(TOWN, GRID, style, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    for name in ("ground", "surface", "canopy_bottom", "canopy_top", "canopy_density", "material"):
        assert np.array_equal(getattr(one, name), getattr(same, name))
    assert np.array_equal(map_one.picture, map_same.picture)
    assert not np.array_equal(one.surface, other.surface)


def test_every_style_gives_a_finite_world_with_a_way_through() -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        world, map_raster = build_area(TOWN, GRID, WorldStyle.random(rng), rng)
        assert np.isfinite(world.surface).all()
        assert (world.surface >= world.ground).all()
        assert map_raster.grid == GRID
        assert world.grid.width_m == pytest.approx(GRID.width_m)
        porous = world.canopy_top > 0
        assert (world.canopy_density[porous] > 0).all()


def test_boundaries_exist_that_no_map_knows_and_the_style_says_how_many_it_does() -> None:
    fenced = replace(BARE, plot_share=1.0, plot_depth_m=15.0, pavement_m=2.0, wall_share=1.0)
    world, unaware = build_area(TOWN, GRID, fenced, np.random.default_rng(3))
    _, aware = build_area(TOWN, GRID, replace(fenced, mapped_share=1.0), np.random.default_rng(3))
    assert unaware.classes is not None
    assert aware.classes is not None
    bare_walls = np.count_nonzero(unaware.classes == CLASS_INDEX["wall"])
    assert np.count_nonzero(aware.classes == CLASS_INDEX["wall"]) > 5 * bare_walls
    walls = world.material == Material.WALL
    assert np.count_nonzero(walls) * world.grid.metres_per_pixel**2 > 20.0
    rows, cols = np.nonzero(walls)
    xy = world.grid.xy_from_pixel(np.stack([rows, cols], axis=-1) + 0.5)
    on_road = (np.abs(xy[:, 1]) < 3.5) | (np.abs(xy[:, 0]) < 3.0)
    assert not on_road.any()


def test_buildings_go_missing_on_either_side() -> None:
    town = MapFeatures(
        tuple(
            Area("building", (box(x, y, x + 6, y + 6),), 6.0, 36.0)
            for x in range(-55, 50, 10)
            for y in range(-55, 50, 10)
        ),
        (),
    )
    world, map_raster = build_area(town, GRID, replace(BARE, lost_share=0.2), np.random.default_rng(0))
    assert map_raster.classes is not None
    centres = np.array([ring.rings[0].mean(axis=0) for ring in town.areas])
    cell = world.cells(centres)
    stands = (world.surface - world.ground)[cell] > 3.0
    rows, cols = np.floor(GRID.pixel_from_xy(centres)).astype(int).T
    drawn = map_raster.classes[rows, cols] == CLASS_INDEX["building"]
    # 121 buildings, each lost with probability 0.2: 24 +- 4.4
    assert 10 < np.count_nonzero(~stands) < 40
    assert 10 < np.count_nonzero(~drawn) < 40
    assert np.any(stands & ~drawn)
    assert np.any(drawn & ~stands)


def test_map_is_shifted_against_the_world() -> None:
    shifts = []
    for seed in range(12):
        world, _ = build_area(TOWN, GRID, replace(BARE, map_offset_m=0.5), np.random.default_rng(seed))
        _, cols = np.nonzero((world.surface - world.ground)[:, world.grid.cols // 2 + 25 :] > 8.0)
        shifts.append(cols.mean() * world.grid.metres_per_pixel)
    assert 0.2 < np.std(shifts) < 1.0


def test_free_space_keeps_its_distance() -> None:
    world, _ = build_area(TOWN, GRID, BARE, np.random.default_rng(0))
    free = world.is_free(np.array([[20.0, 0.0], [20.0, 8.5], [20.0, 6.0], [20.0, 17.0], [500.0, 0.0]]), radius_m=2.0)
    assert free.tolist() == [True, False, True, False, False]


def test_road_poses_lie_on_roads_and_along_them() -> None:
    rng = np.random.default_rng(0)
    world, _ = build_area(TOWN, GRID, WorldStyle(), rng)
    poses = sample_road_poses(world, 30, rng, margin_m=20.0)
    assert 0 < len(poses) <= 30
    assert np.abs(poses[:, :2]).max() <= 40.0
    assert (np.abs(poses[:, :2]).min(axis=1) < 3.5).all()
    along = np.abs(np.where(np.abs(poses[:, 1]) < np.abs(poses[:, 0]), np.sin(poses[:, 2]), np.cos(poses[:, 2])))
    assert np.median(along) < 0.1
    assert world.is_free(poses[:, :2], 1.5).all()


def test_road_poses_of_a_place_without_roads_are_none() -> None:
    rng = np.random.default_rng(0)
    world, _ = build_area(MapFeatures(TOWN.areas, ()), GRID, BARE, rng)
    assert sample_road_poses(world, 5, rng).shape == (0, 3)


def raster_town(road_width: int) -> MapRaster:
    classes = np.zeros((300, 300), dtype=np.uint8)
    classes[150 - road_width // 2 : 150 + (road_width + 1) // 2] = CLASS_INDEX["road"]
    classes[60:100, 50:110] = CLASS_INDEX["building"]
    classes[200:260, 50:250] = CLASS_INDEX["forest"]
    return MapRaster.from_classes(MapGrid(300, 300, 0.33, 10.0, -20.0), classes)


def test_class_raster_is_extruded_in_place() -> None:
    map_raster = raster_town(24)
    world = world_from_raster(map_raster, 0)
    middle = map_raster.grid.xy_from_pixel(np.array([[80.0, 80.0], [230.0, 150.0], [150.0, 150.0]]))
    assert height_at(world, *middle[0]) >= 3.0
    assert world.material[world.cells(middle)].tolist()[0] == Material.BUILDING
    assert world.material[world.cells(middle)].tolist()[2] in (Material.ROAD, Material.CAR)
    assert map_raster.classes is not None
    building = map_raster.classes == CLASS_INDEX["building"]
    assert np.array_equal(world.material == Material.BUILDING, building)
    porous = world.canopy_top > 0
    assert porous[205:255, 55:245].mean() > 3 * porous[10:50, 150:290].mean()


def test_class_raster_worlds_repeat() -> None:
    one, same, other = (world_from_raster(raster_town(24), seed) for seed in (4, 4, 5))
    assert np.array_equal(one.surface, same.surface)
    assert np.array_equal(one.canopy_top, same.canopy_top)
    assert not np.array_equal(one.surface, other.surface)


def test_roads_drawn_as_centrelines_are_widened() -> None:
    world = world_from_raster(raster_town(1), 0)
    road = np.isin(world.material, (Material.ROAD, Material.CAR))
    width = np.count_nonzero(road[100:200, 10:290], axis=0) * world.grid.metres_per_pixel
    assert 5.0 < np.median(width) < 10.0


def test_photograph_is_no_world() -> None:
    picture = np.zeros((20, 20, 3), dtype=np.uint8)
    with pytest.raises(SkyfixError, match="world: expected a map with classes"):
        world_from_raster(MapRaster(MapGrid(20, 20, 0.5, 0.0, 0.0), None, picture), 0)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.75])
def test_painting_is_accurate_below_a_pixel(fraction: float) -> None:
    grid = MapGrid(100, 100, 1.0, 5.0, -7.0)
    square = box(30.0, 20.0, 60.0, 50.0) + fraction
    raster = np.zeros((100, 100), dtype=np.uint8)
    paint.fill(raster, grid, [square], 1)
    rows, cols = np.nonzero(raster)
    centre = grid.xy_from_pixel(np.array([rows.mean() + 0.5, cols.mean() + 0.5]))
    assert centre == pytest.approx(square.mean(axis=0), abs=0.51)
    disc = np.zeros((100, 100), dtype=np.uint8)
    paint.disc(disc, grid, np.array([40.0, 30.0]), 8.0, 1)
    assert np.count_nonzero(disc) == pytest.approx(np.pi * 64.0, rel=0.1)


@pytest.mark.parametrize("width_m", [0.0, 0.3, 0.7, 1.0, 3.0, 7.0])
@pytest.mark.parametrize("slant", [0.0, 20.0])
def test_strokes_have_their_width(width_m: float, slant: float) -> None:
    grid = MapGrid(400, 400, 0.2, 0.0, 0.0)
    raster = np.zeros((400, 400), dtype=np.uint8)
    paint.stroke(raster, grid, np.array([[5.0, 30.0], [75.0, 30.0 + slant]]), 1, width_m)
    across = np.count_nonzero(raster[:, 200]) * 0.2 * np.cos(np.arctan2(slant, 70.0))
    assert across == pytest.approx(max(width_m, 0.2), abs=0.21)


@pytest.mark.parametrize("seed", range(4))
def test_from_above_shows_buildings_and_roads_where_the_map_draws_them(seed: int) -> None:
    world, drawn = build_area(TOWN, GRID, BARE, np.random.default_rng(seed))
    seen = overhead_map(world, GRID, 0.0, np.random.default_rng(seed))
    assert drawn.classes is not None
    assert seen.classes is not None
    drawn_houses, houses = (raster == CLASS_INDEX["building"] for raster in (drawn.classes, seen.classes))
    assert np.count_nonzero(drawn_houses & houses) > 0.85 * np.count_nonzero(drawn_houses | houses)
    middles = [np.argwhere(mask).mean(axis=0) for mask in (drawn_houses, houses)]
    assert np.abs(middles[0] - middles[1]).max() < 1.0  # walls of this town lie on the borders of pixels
    roads, carriageways = (raster == CLASS_INDEX["road"] for raster in (drawn.classes, seen.classes))
    assert np.count_nonzero(roads & carriageways) > 0.95 * np.count_nonzero(roads)
    lanes_m2 = 0.25 * np.count_nonzero(carriageways)
    assert lanes_m2 == pytest.approx(120.0 * 13.0 - 42.0 + 900.0, rel=0.1)  # both roads and the car park


def test_from_above_crowns_hide_the_road_and_walls_are_too_thin() -> None:
    leafy = replace(BARE, tree_density=8.0, mapped_share=1.0)
    world, _ = build_area(TOWN, GRID, leafy, np.random.default_rng(2))
    seen = overhead_map(world, GRID, 0.0, np.random.default_rng(0)).classes
    assert seen is not None
    rows, cols = np.nonzero(seen == CLASS_INDEX["forest"])
    tops = world.canopy_top[world.cells(GRID.xy_from_pixel(np.column_stack([rows, cols]) + 0.5))]
    assert len(rows) > 100
    assert np.mean(tops > 0) > 0.75
    assert not np.isin(seen, [CLASS_INDEX[name] for name in ("wall", "fence", "hedge", "tree")]).any()


def test_from_above_is_decided_by_the_generator_and_shifted_as_asked() -> None:
    world, _ = build_area(TOWN, GRID, BARE, np.random.default_rng(0))
    once, again, other = (overhead_map(world, GRID, 0.0, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(once.picture, again.picture)
    assert not np.array_equal(once.picture, other.picture)
    middles = []
    for seed in range(60):
        classes = overhead_map(world, GRID, 2.0, np.random.default_rng(seed)).classes
        assert classes is not None
        middles.append(0.5 * np.argwhere(classes == CLASS_INDEX["building"]).mean(axis=0))
    spread = np.std(middles, axis=0)  # metres; of 60 draws the estimate is within 1.0 of 2.0 with more than 5 sigma
    assert (np.abs(spread - 2.0) < 1.0).all()


def test_where_one_can_drive_is_all_that_such_a_map_shows() -> None:
    world, _ = build_area(TOWN, GRID, replace(BARE, poles_per_100m=20.0), np.random.default_rng(0))
    shown = drivable_map(world, GRID, 0.0, np.random.default_rng(0)).classes
    assert shown is not None
    assert set(np.unique(shown)) == {CLASS_INDEX["void"], CLASS_INDEX["road"]}
    paved_m2 = 0.25 * np.count_nonzero(shown == CLASS_INDEX["road"])
    assert paved_m2 == pytest.approx(120.0 * 13.0 - 42.0 + 900.0, rel=0.05)  # both roads and the car park, no holes
