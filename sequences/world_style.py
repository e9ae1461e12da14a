"""How a simulated world deviates from its map: the random style of a neighbourhood.

A share of the worlds is open, with wide verges and little clutter. A network trained on one tidy style of world
does not carry over to real scans, so every world draws its own: how hilly it is, how many garden fences, walls and
hedges there are and how many of them a map knows, how dense the vegetation is, how many cars are parked, and by how
much the map is shifted and out of date.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class WorldStyle:
    """Parameters of a world; lengths in metres, shares in [0, 1].

    Attributes
    ----------
    slope, hill_amplitude_m, bank_amplitude_m, roughness_m
        Grade of the terrain as a whole, size of its hills, of the banks beside roads and of the unevenness off roads.
    kerb_m
        Step from carriageway to pavement.
    road_width_factor, pavement_m
        Carriageway width against what the tags say, and pavement beside it.
    plot_share, plot_depth_m, wall_share, hedge_share, bush_share
        Share of road frontage that has a garden boundary, how deep gardens are, and what the boundary is (else a
        fence).
    mapped_share
        Share of those boundaries that the map knows.
    area_boundary_share
        Share of parks, woods and car parks with a boundary around them.
    lost_share
        Share of mapped things that are not in the world, and of buildings that are not on the map.
    map_offset_m, building_shift_m, building_turn_deg
        Standard deviations: map against world as a whole, each building beside that (also smoothly varying over 25
        m).
    shed_density, tree_density, bush_density
        Things per 1000 square metres of open ground.
    forest_spacing_m
        Distance of trees in woods.
    undergrowth
        Share of unpaved ground that is overgrown.
    foliage_per_m
        Typical chance density of a laser return in foliage, 1/m.
    parked_share, car_park_share, traffic_per_km
        Share of roadside parking places and car-park places taken; moving cars.
    poles_per_100m, pedestrians_per_100m
        Street furniture and people along roads.
    median_share
        Share of wide roads with a median strip or guard rail.
    divided_share, mapped_strip_share, mapped_pavement_share
        Share of larger roads that are divided by a median, and of road sides with a verge or parking strip and with a
        pavement that the map draws.
    extrusion_share
        Share of facades with balconies, porches and bays.
    storeys
        Mean number of storeys where the map does not say.
    """

    slope: float = 0.02
    hill_amplitude_m: float = 0.4
    bank_amplitude_m: float = 0.3
    roughness_m: float = 0.05
    kerb_m: float = 0.11
    road_width_factor: float = 1.0
    pavement_m: float = 1.8
    plot_share: float = 0.75
    plot_depth_m: float = 20.0
    wall_share: float = 0.25
    hedge_share: float = 0.35
    bush_share: float = 0.15
    mapped_share: float = 0.2
    area_boundary_share: float = 0.35
    lost_share: float = 0.05
    map_offset_m: float = 0.35
    building_shift_m: float = 0.2
    building_turn_deg: float = 0.5
    shed_density: float = 0.6
    tree_density: float = 2.0
    bush_density: float = 6.0
    forest_spacing_m: float = 5.0
    undergrowth: float = 0.1
    foliage_per_m: float = 1.2
    parked_share: float = 0.45
    car_park_share: float = 0.5
    traffic_per_km: float = 6.0
    poles_per_100m: float = 5.0
    pedestrians_per_100m: float = 1.0
    median_share: float = 0.5
    divided_share: float = 0.0
    mapped_strip_share: float = 0.0
    mapped_pavement_share: float = 0.0
    extrusion_share: float = 0.4
    storeys: float = 2.5

    @classmethod
    def random(cls, rng: np.random.Generator) -> WorldStyle:
        """Draw a style; the same generator state gives the same style."""
        shares = rng.dirichlet([1.0, 1.3, 0.8, 1.2])
        clutter = float(rng.uniform(0.05, 0.4)) if rng.random() < 0.25 else 1.0
        verge_m = float(rng.uniform(0.0, 8.0)) if clutter < 1.0 else 0.0
        return cls(
            slope=float(abs(rng.normal(0.0, 0.03))),
            hill_amplitude_m=float(rng.gamma(1.2, 0.35)),
            bank_amplitude_m=float(rng.gamma(1.0, 0.45)),
            roughness_m=float(rng.gamma(2.0, 0.03)),
            kerb_m=float(rng.uniform(0.0, 0.15)),
            road_width_factor=float(rng.uniform(0.9, 1.7)),
            pavement_m=float(rng.uniform(0.8, 4.5)) + verge_m,
            plot_share=clutter * float(rng.beta(1.2, 0.9)),
            plot_depth_m=float(rng.uniform(8.0, 35.0)),
            wall_share=float(shares[0]),
            hedge_share=float(shares[1]),
            bush_share=float(shares[2]),
            mapped_share=float(rng.beta(0.5, 1.0)),
            area_boundary_share=float(rng.beta(1.0, 1.5)),
            lost_share=float(rng.uniform(0.0, 0.12)),
            map_offset_m=0.35,
            building_shift_m=float(rng.uniform(0.05, 0.35)),
            building_turn_deg=float(rng.uniform(0.1, 1.0)),
            shed_density=clutter * float(rng.gamma(1.5, 0.5)),
            tree_density=clutter * float(rng.gamma(1.2, 2.2)),
            bush_density=clutter * float(rng.gamma(1.0, 5.0)),
            forest_spacing_m=float(rng.uniform(3.0, 8.0)),
            undergrowth=clutter * float(rng.beta(0.7, 5.0)),
            foliage_per_m=float(np.exp(rng.uniform(np.log(0.3), np.log(5.0)))),
            parked_share=clutter * float(rng.beta(0.7, 1.6)),
            car_park_share=float(rng.beta(1.5, 1.5)),
            traffic_per_km=clutter * float(rng.gamma(1.0, 8.0)),
            poles_per_100m=float(rng.gamma(2.0, 2.5)),
            pedestrians_per_100m=float(rng.gamma(0.7, 1.5)),
            median_share=float(rng.beta(1.0, 1.0)),
            divided_share=float(rng.uniform(0.3, 1.0)) if rng.random() < 0.25 else 0.0,
            mapped_strip_share=float(rng.beta(0.5, 1.5)),
            mapped_pavement_share=float(rng.beta(0.4, 1.0)),
            extrusion_share=float(rng.beta(1.0, 1.3)),
            storeys=float(rng.uniform(1.5, 5.0)),
        )
