"""From configuration to simulated samples to a calibrated checkpoint, on the extract that pyrosm carries."""

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import sequences.train_budget
import sequences.training_data
from fusion.errors import SkyfixError
from learned.map_raster import CLASSES
from learned.matcher import load_matcher
from learned.training import NetworkChoice
from sequences.held_out import calibration_settings, evaluation_settings
from sequences.lidar import LidarModel, simulate_scan
from sequences.osm import Line, MapFeatures, read_osm
from sequences.train_budget import steps_within
from sequences.train_command import TrainOptions, train_from_config
from sequences.train_config import TrainConfig, first_difference, read_config
from sequences.training_data import SimulatedSamples, SimulationSettings
from sequences.world import build_area
from sequences.world_style import WorldStyle

TINY = """
extracts: {"pyrosm:test.osm.pbf": 1.0}
validation_extract: pyrosm:test.osm.pbf
validation_samples: 2
calibration_samples: 2
matching_half_extent_m: 48.0
simulation: {samples: 2, samples_per_area: 2, azimuths: [300, 300]}
training:
  steps: 1
  batch: 2
  workers: 0
  network: {channels: 4, widths: [4, 4, 8, 8]}
"""


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


def test_a_checkpoint_comes_out_calibrated_and_with_its_provenance(tiny: Path, tmp_path: Path) -> None:
    path = train_from_config(tiny, tmp_path, tmp_path / "out")
    facts = json.loads(path.with_suffix(".json").read_text())
    assert facts["command"] == "skyfix train tiny.yaml"
    assert facts["config"]["simulation"]["seed"] == 0
    assert facts["validation"]["samples"] == 2
    assert facts["settings"]["bev"]["half_extent_m"] == 48.0
    assert facts["config"]["training"]["network"]["bev"]["half_extent_m"] == 40.0
    assert facts["calibration"]["temperature"] != 1.0
    assert load_matcher(str(path)).name == "rotmatch"
    assert 0.0 <= facts["validation"]["coverage_90"] <= 1.0
    for name in ("loss.png", "calibration.png", "validation/step_000001_0.png", "validation/step_000001_1.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG"), name
    resolved = read_config(tmp_path / "out" / "config.yaml")
    assert resolved == read_config(tiny)
    with pytest.raises(SkyfixError, match=r"other settings, training\.seed 0 and not 3; choose another --out"):
        train_from_config(tiny, tmp_path, tmp_path / "out", options=TrainOptions(("training.seed=3",)))
    other = TrainOptions(("simulation.least_buildings=2",), cache_dir=tmp_path / "out" / "cache")
    with pytest.raises(SkyfixError, match="were made with least_buildings 5, these need 2; choose another folder"):
        train_from_config(tiny, tmp_path, tmp_path / "other", options=other)


def test_networks_of_another_reach_share_a_cache(tiny: Path, tmp_path: Path) -> None:
    """What they are calibrated on differs with the reach, what they are trained on does not."""
    cache = tmp_path / "cache"
    train_from_config(tiny, tmp_path, tmp_path / "one", options=TrainOptions(cache_dir=cache))
    farther = TrainOptions(("matching_half_extent_m=52",), cache_dir=cache)
    assert train_from_config(tiny, tmp_path, tmp_path / "two", options=farther).exists()
    (cache / "calibration_56m").mkdir()
    (cache / "calibration_56m" / "made_with.json").write_text((cache / "calibration_52m/made_with.json").read_text())
    spoilt = TrainOptions(("matching_half_extent_m=56",), cache_dir=cache)
    with pytest.raises(SkyfixError, match="calibration_56m: its samples were made with"):
        train_from_config(tiny, tmp_path, tmp_path / "three", options=spoilt)
    assert not (tmp_path / "three" / "state.pt").exists()  # before a step was taken, not after the last


def test_training_goes_on_from_a_checkpoint(tiny: Path, tmp_path: Path) -> None:
    """With steps of no length the weights are those that it started from; another network's are refused."""
    first = train_from_config(tiny, tmp_path, tmp_path / "first")
    cache = tmp_path / "first" / "cache"
    options = TrainOptions(("training.learning_rate=1e-12", "training.seed=7"), cache_dir=cache, initial=first)
    second = train_from_config(tiny, tmp_path, tmp_path / "second", options=options)
    before, after = load_file(first), load_file(second)
    assert all(torch.allclose(before[name], after[name], atol=1e-6) for name in before)
    facts = json.loads(second.with_suffix(".json").read_text())
    assert facts["command"].endswith("--initial rotmatch.safetensors")
    assert facts["config"]["initial"].startswith("rotmatch.safetensors sha256:")
    with pytest.raises(SkyfixError, match="holds a training with other settings, initial"):
        train_from_config(tiny, tmp_path, tmp_path / "second", options=replace(options, initial=None))
    learned_much = ("training.learning_rate=1.0", "training.clip_norm=1e6", "training.warmup_steps=1")
    alone = train_from_config(tiny, tmp_path, tmp_path / "alone", options=replace(options, overrides=learned_much))
    shares = replace(options, overrides=(*learned_much, "averaged_shares=[0.5, 0.2]"), averaged=(first, alone))
    mixed = train_from_config(tiny, tmp_path, tmp_path / "mixed", options=shares)
    other, kept = load_file(alone), load_file(mixed)
    for name, value in before.items():
        assert torch.allclose(kept[name], 0.5 * other[name] + 0.5 * value, atol=1e-5), name
    facts = json.loads(mixed.with_suffix(".json").read_text())
    assert facts["command"].endswith("--average rotmatch.safetensors --average rotmatch.safetensors")
    assert len(facts["config"]["averaged"]) == 2
    with pytest.raises(SkyfixError, match="averaged_shares: expected a --average for each of 1, got 0"):
        train_from_config(tiny, tmp_path, tmp_path / "none", options=TrainOptions(("averaged_shares=[0.5]",)))
    with pytest.raises(SkyfixError, match=r"averaged_shares: expected a sum below 1, got 1\.2"):
        train_from_config(tiny, tmp_path, tmp_path / "none", options=TrainOptions(("averaged_shares=[0.6, 0.6]",)))
    assert not (tmp_path / "none").exists()
    wider = replace(options, overrides=("training.network.channels=6",))
    with pytest.raises(SkyfixError, match="the initial weights do not fit the network"):
        train_from_config(tiny, tmp_path, tmp_path / "third", options=wider)


def test_minutes_become_steps_once(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock says a second a look: 0.5 minutes hold as many steps as the timed seconds allow."""
    clock = iter(range(10_000))
    monkeypatch.setattr(sequences.train_budget.time, "perf_counter", lambda: float(next(clock)))
    config = read_config(tiny)
    with resources.as_file(resources.files("pyrosm") / "data" / "test.osm.pbf") as path:
        extracts = [(read_osm(path), 1.0)]
    sources = [SimulatedSamples(extracts, replace(config.simulation, seed=s), tmp_path / str(s)) for s in (0, 1)]
    for source in sources:
        source.area(0)
    settings = replace(config.training, validate_every=4)
    # A second a step, and 2 samples of a second each every 4 steps: 1.5 seconds a step.
    assert steps_within(0.5, sources[0], sources[1], settings) == 20
    with pytest.raises(SkyfixError, match=r"--minutes: expected above zero, got 0"):
        steps_within(0.0, sources[0], sources[1], settings)
    with pytest.raises(SkyfixError, match=r"expected at least 0\.1 for a single step, got 0\.01"):
        steps_within(0.01, sources[0], sources[1], settings)


@pytest.mark.parametrize(
    ("overhead", "drivable", "shown"),
    [(0.0, 0.0, {"building", "road", "path"}), (1.0, 0.0, {"building", "road", "forest"}), (1.0, 1.0, {"road"})],
)
def test_samples_show_the_kind_of_map_asked_for(
    tiny: Path, tmp_path: Path, overhead: float, drivable: float, shown: set[str]
) -> None:
    with resources.as_file(resources.files("pyrosm") / "data" / "test.osm.pbf") as path:
        extracts = [(read_osm(path), 1.0)]
    how = replace(read_config(tiny).simulation, overhead_share=overhead, drivable_share=drivable)
    source = SimulatedSamples(extracts, how, tmp_path / "cache")
    seen = {CLASSES[index] for area in range(2) for sample in source.area(area) for index in np.unique(sample.classes)}
    assert shown <= seen
    thin = {"wall", "fence", "hedge", "path", "tree"}
    assert bool(seen & thin) == (overhead == 0.0)
    if drivable:
        assert seen == {"void", "road"}


def test_worlds_and_sensors_have_what_they_are_given(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two neighbourhoods, the rest of their style drawn as without."""
    with resources.as_file(resources.files("pyrosm") / "data" / "test.osm.pbf") as path:
        extracts = [(read_osm(path), 1.0)]
    drawn = read_config(tiny).simulation
    given = replace(drawn, world={"slope": 0.5, "tree_density": 0.0}, sensor={"mount_height_m": 1.23})
    seen: list[tuple[WorldStyle, LidarModel]] = []
    styles: list[WorldStyle] = []

    def spy_area(features: Any, grid: Any, style: WorldStyle, rng: Any) -> Any:
        styles.append(style)
        return build_area(features, grid, style, rng)

    def spy_scan(world: Any, pose: Any, model: LidarModel, rng: Any) -> Any:
        seen.append((styles[-1], model))
        return simulate_scan(world, pose, model, rng)

    monkeypatch.setattr(sequences.training_data, "build_area", spy_area)
    monkeypatch.setattr(sequences.training_data, "simulate_scan", spy_scan)
    for how in (drawn, given):
        for area in range(2):
            SimulatedSamples(extracts, how, tmp_path / str(how is given)).area(area)
    without, with_given = seen[:4], seen[4:]
    assert {(style.slope, style.tree_density, model.mount_height_m) for style, model in with_given} == {
        (0.5, 0.0, 1.23)
    }
    assert len({style.slope for style, _ in without}) == 2
    for (style, _), (other, _) in zip(without, with_given, strict=True):
        assert replace(style, slope=0.5, tree_density=0.0) == other


def test_heights_of_samples_are_above_the_ground_asked_for(tiny: Path, tmp_path: Path) -> None:
    """Among hills, a plane has their sides in the bands of walls; a slope as a whole the vehicle leans with."""
    with resources.as_file(resources.files("pyrosm") / "data" / "test.osm.pbf") as path:
        extracts = [(read_osm(path), 1.0)]
    hilly = replace(read_config(tiny).simulation, world={"hill_amplitude_m": 2.0})
    on_ground = []
    for how in (hilly, replace(hilly, ground="plane")):
        samples = SimulatedSamples(extracts, how, tmp_path / how.ground).area(0)
        on_ground.append(np.mean([sample.counts[0].sum() / sample.counts.sum() for sample in samples]))
    assert on_ground[0] > 1.02 * on_ground[1]


def test_networks_of_other_worlds_are_compared_in_drawn_ones(tiny: Path) -> None:
    config = read_config(tiny, ["simulation.world={slope: 0.0}", "simulation.sensor={tilt_noise_deg: 0.0}"])
    assert calibration_settings(config).world == {"slope": 0.0}
    assert evaluation_settings(config, 8, 20.0) == evaluation_settings(read_config(tiny), 8, 20.0)


def test_overrides_are_typed_and_checked(tiny: Path) -> None:
    changed = read_config(tiny, ["training.steps=7", "training.network={architecture: rotmatch, channels: 6}"])
    assert changed.training.steps == 7
    assert changed.training.network.settings.channels == 6
    assert read_config(tiny, ["training.ema_decay=0.99"]).training.ema_decay == 0.99
    for override, message in (
        ("training.stepps=7", r"training\.stepps"),
        ("training.steps=many", r"training\.steps: .*'many'"),
        ("training.steps", "--set: expected KEY.KEY=VALUE, got 'training.steps'"),
        ("training.steps.more=1", r"--set training\.steps\.more: expected a mapping at steps, got 1"),
        ("training.steps=[", r"--set training\.steps: expected a YAML value"),
        ("training.network.architecture=nothing", "expected one of .*rotmatch.*, got 'nothing'"),
        ("training.network.chanels=4", "rotmatch settings: chanels"),
        ("simulation.bev_half_extent_m=30", "expected 40 as training.network.bev, got 30"),
        ("simulation.ground=plane", "expected surface as training.network.bev, got plane"),
        ("simulation.world={slopes: 0.0}", r"simulation\.world: expected one of .*slope.*, got slopes"),
        ("simulation.sensor={azimuths: 100}", r"simulation\.sensor: expected one of .*tilt_noise_deg.*, got azimuths"),
        ("simulation.samples=-4", r"simulation\.samples: expected zero or more, got -4"),
        ("simulation.samples_per_area=0", r"simulation\.samples_per_area: expected above zero, got 0"),
        ("training.augmentation.rotate_deg=200", "augmentation rotate_deg: expected 0 to 180, got 200"),
        ("training.augmentation.crop_px=0", "augmentation: expected .* crop_px >= 1, got 40, 0"),
        ("simulation.overhead_share=1.5", r"simulation\.overhead_share: expected 0 to 1, got 1\.5"),
        ("training.augmentation.rotate=7", "augmentation rotate: expected 0 to 1, got 7"),
        ("training.augmentation.thin=.nan", "augmentation thin: expected 0 to 1, got nan"),
        ("training.augmentation.half_heading_deg=-5", "augmentation half_heading_deg: expected 0 to 180, got -5"),
        ("training.augmentation.max_offset_px=-3", "augmentation: expected max_offset_px >= 0 .* got -3, 256"),
        ("calibration_samples=1", "calibration_samples: .*greater than or equal to 2"),
        ("validation_samples=0", "validation_samples: .*greater than or equal to 1"),
        ("extracts={a: 0.0}", r"extracts\.a: .*greater than 0"),
        ("extracts={a: .inf}", r"extracts\.a: .*finite number"),
    ):
        with pytest.raises(SkyfixError, match=message) as caught:
            read_config(tiny, [override])
        assert "\n" not in str(caught.value)


def test_a_training_can_be_calibrated_on_more_samples_afterwards(tiny: Path) -> None:
    few, many = read_config(tiny, ["calibration_samples=2"]), read_config(tiny, ["calibration_samples=9"])
    assert first_difference(few, many) is None
    assert first_difference(few, read_config(tiny, ["training.seed=9"])) is not None


def test_a_configuration_that_went_on_from_a_checkpoint_asks_for_it_again(tiny: Path, tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match=r"initial: expected --initial near\.safetensors sha256:12, got none"):
        train_from_config(
            tiny, tmp_path, tmp_path / "out", options=TrainOptions(("initial=near.safetensors sha256:12",))
        )
    assert not (tmp_path / "out").exists()


def test_the_shipped_weights_configuration_is_still_one() -> None:
    """Five stages, each from the weights of the one before; the last three are averaged."""
    weights = Path(sequences.__file__).parents[1] / "learned" / "weights"
    stages = [weights / f"rotmatch{stage}.yaml" for stage in ("_near", "_far", "_overhead", "_overgrown", "")]
    near, far, overhead, overgrown, last = (read_config(stage) for stage in stages)
    assert near.training.network == NetworkChoice("rotmatch")
    assert (near.matching_reach_m, near.averaged_shares) == (72.0, ())
    assert far.training.network.settings.bev.half_extent_m == far.matching_reach_m == 72.0
    assert last.training.network.settings.bev.half_extent_m == last.matching_reach_m == 72.0
    assert overhead.simulation.overgrown_share == 0.0 < overhead.simulation.overhead_share
    assert min(overgrown.simulation.overgrown_share, overgrown.simulation.drivable_share) > 0.0
    assert sum(last.averaged_shares) == pytest.approx(2 / 3, abs=1e-5)
    made = TrainConfig.model_validate(json.loads((weights / "rotmatch.json").read_text(encoding="utf-8"))["config"])
    assert made.model_copy(update={"initial": None, "averaged": ()}) == last


def test_a_cache_is_shared_by_runs_of_one_simulation_alone(tmp_path: Path) -> None:
    roads = MapFeatures((), (Line("road", np.array([[0.0, 0.0], [50.0, 0.0]])),))
    settings = SimulationSettings(samples=4)
    SimulatedSamples([(roads, 1.0)], settings, tmp_path / "cache")
    SimulatedSamples([(roads, 1.0)], replace(settings, samples=40), tmp_path / "cache")
    wider = replace(roads, lines=(Line("road", np.array([[0.0, 0.0], [60.0, 0.0]])),))
    for extracts, how, message in (
        ([(roads, 1.0)], replace(settings, seed=3), "made with seed 0, these need 3; choose another folder"),
        ([(roads, 1.0)], replace(settings, world={"slope": 0.0}), r"made with world None, these need {'slope': 0\.0}"),
        ([(roads, 2.0)], settings, "made with extracts"),
        ([(wider, 1.0)], settings, "made with extracts"),
    ):
        with pytest.raises(SkyfixError, match=message):
            SimulatedSamples(extracts, how, tmp_path / "cache")
    SimulatedSamples([(roads, 1.0)], replace(settings, ground="plane"), tmp_path / "plane")
    with pytest.raises(SkyfixError, match="made with ground plane, these need None"):
        SimulatedSamples([(roads, 1.0)], settings, tmp_path / "plane")
    (tmp_path / "cache" / "made_with.json").unlink()
    (tmp_path / "cache" / "area_00000.npz").write_bytes(b"")
    with pytest.raises(SkyfixError, match=r"holds samples but no made_with\.json"):
        SimulatedSamples([(roads, 1.0)], settings, tmp_path / "cache")
    (tmp_path / "file").write_text("")
    with pytest.raises(SkyfixError, match="cannot be used: Not a directory"):
        SimulatedSamples([(roads, 1.0)], settings, tmp_path / "file" / "cache")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extracts: {}\nvalidation_extract: a\nsteps: 3", "steps: Extra inputs"),
        (TINY.replace("steps: 1", "stepps: 1"), "stepps"),
        (TINY.replace("steps: 1", "steps: many"), "training.steps"),
        ("extracts: [", "expected YAML"),
    ],
)
def test_bad_configurations_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(SkyfixError, match=message) as caught:
        read_config(path)
    assert "\n" not in str(caught.value)


def test_samples_depend_on_seed_and_number_alone(tmp_path: Path) -> None:
    with resources.as_file(resources.files("pyrosm") / "data" / "test.osm.pbf") as path:
        extracts = [(read_osm(path), 1.0)]
    settings = SimulationSettings(samples=4, samples_per_area=2, azimuths=(300, 300))
    first = SimulatedSamples(extracts, settings, tmp_path / "a")
    second = SimulatedSamples(extracts, settings, tmp_path / "b")
    for index in (3, 0):
        made, cached, other = first[index], SimulatedSamples(extracts, settings, tmp_path / "a")[index], second[index]
        for again in (cached, other):
            np.testing.assert_array_equal(made.counts, again.counts)
            np.testing.assert_array_equal(made.classes, again.classes)
            assert (made.row, made.col, made.yaw) == (again.row, again.col, again.yaw)
        assert made.counts[0].sum() > 1000
        assert 80 <= made.row <= 256
        assert 80 <= made.col <= 256
    order = first.order(np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(order), np.arange(4))
    area = tmp_path / "a" / "area_00000.npz"
    for damaged in (b"", area.read_bytes()[:5000], b"nothing"):  # made again
        area.write_bytes(damaged)
        again = SimulatedSamples(extracts, settings, tmp_path / "a")[0]
        np.testing.assert_array_equal(again.counts, second[0].counts)
        assert area.stat().st_size > 5000
