"""AGL-Net: alignment of scales, skeletons, two stages that make one density, and poses found in all quadrants."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from landmark_scenes import (
    BEV,
    BLIND_NLL,
    CROP_PX,
    QUADRANTS,
    QUICK,
    Scene,
    assert_a_batch_is_the_sum_of_its_parts,
    assert_checkpoint_round_trip,
    assert_finds,
    assert_gradients_reach_everything,
    assert_refuses_bad_images,
    batch_of,
    fit,
    matched,
    scene,
)

from fusion.errors import SkyfixError
from learned.aglnet import ARCHITECTURE, AglNet, AglNetMatcher, AglNetSettings
from learned.losses import HeadingQuadrature
from learned.skeleton import skeleton_loss, skeleton_targets
from learned.two_stage import RefinementSettings, Window, headings_within, refined
from learned.warps import scaled_maps, scaled_scans, seen_from

TINY = AglNetSettings(4, 4, 2, (8, 8, 8, 8), bev=BEV, quadrature=QUICK)
HEADINGS = torch.arange(24) * (2 * math.pi / 24)


def net_of(settings: AglNetSettings = TINY, seed: int = 0) -> AglNet:
    torch.manual_seed(seed)
    return AglNet(settings)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [scene(seed, yaw) for seed, yaw in enumerate(QUADRANTS)]


@pytest.fixture(scope="module")
def fitted(scenes: list[Scene]) -> AglNet:
    """A network that learned the scenes on maps of any scale."""
    net = net_of(replace(TINY, scale_weight=1.0))
    totals = fit(net, batch_of(scenes), 36)
    assert totals[-1] < totals[0] - 5.0
    return net


def test_learns_scenes_and_finds_their_poses_in_all_quadrants(scenes: list[Scene]) -> None:
    net = net_of(replace(TINY, coarse_level=1, scales=(1.0,)))
    fit(net, batch_of(scenes), 18)
    with torch.inference_mode():
        nll = net.truth_nll(batch_of(scenes), torch.Generator().manual_seed(0))
    assert float(nll.max()) < BLIND_NLL - 4.0
    for one in scenes:
        assert_finds(AglNetMatcher(net, yaw_bins=72), one, metres=1.0, degrees=5.0)


def test_the_scale_of_a_map_is_told_and_the_pose_found_on_it(fitted: AglNet, scenes: list[Scene]) -> None:
    net = fitted
    batch = batch_of(scenes)
    told = []
    for scale in net.settings.scales:
        scales = torch.full((len(scenes),), scale)
        picture = scaled_maps(batch.picture, batch.row, batch.col, scales)
        with torch.inference_mode():
            scan, found = net.features(batch.density, picture)
            told += [
                net.settings.scales[int(net.scale_logits(scan.coarse[i], found.coarse[i], HEADINGS).argmax())] == scale
                for i in range(len(scenes))
            ]
            nll = net.truth_nll(replace(batch, picture=picture), torch.Generator().manual_seed(0))
        assert float(nll.median()) < BLIND_NLL - 3.0
    # By chance 4 of 12; 9 or more have a probability of 0.4 %.
    assert sum(told) >= 9


def test_the_fine_stage_is_finer(fitted: AglNet, scenes: list[Scene]) -> None:
    """With the second stage the likelihood of the truth is higher than with the first alone."""
    net = fitted
    coarse = AglNet(replace(net.settings, refinement=replace(net.settings.refinement, modes=0)))
    coarse.load_state_dict(net.state_dict())
    batch = batch_of(scenes)
    with torch.inference_mode():
        both, first = (n.eval().truth_nll(batch, torch.Generator().manual_seed(0)).mean() for n in (net, coarse))
    assert float(both) < float(first) - 1.0


def test_volume_is_normalised(scenes: list[Scene]) -> None:
    volume = matched(AglNetMatcher(net_of(), yaw_bins=36), scenes[0])
    assert np.exp(volume.log_prob, dtype=np.float64).sum() * volume.cell_volume == pytest.approx(1.0, rel=1e-4)
    assert volume.grid.metres_per_pixel == pytest.approx(1.0)


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("scales", [(1.0,), (0.8, 1.0, 1.25)])
def test_gradients_reach_every_parameter(level: int, scales: tuple[float, ...]) -> None:
    net = net_of(replace(TINY, coarse_level=level, scales=scales))
    assert_gradients_reach_everything(net, batch_of([scene(0), scene(1)]))
    assert_gradients_reach_everything(net, batch_of([scene(2)]))


def test_losses_add_up_and_each_can_be_taken_away() -> None:
    batch = batch_of([scene(0), scene(1)])

    def terms(settings: AglNetSettings) -> dict[str, float]:
        found = net_of(settings).losses(batch, torch.Generator().manual_seed(2))
        return {name: float(term.detach()) for name, term in found.items()}

    full = terms(TINY)
    assert set(full) == {"total", "coarse", "fine", "skeleton", "scale"}
    expected = full["coarse"] + full["fine"] + 0.5 * full["skeleton"] + 0.1 * full["scale"]
    assert full["total"] == pytest.approx(expected, rel=1e-5)
    without = terms(replace(TINY, skeleton_weight=0.0))
    assert without["total"] == pytest.approx(full["total"] - 0.5 * full["skeleton"], rel=1e-5)
    one_scale = net_of(replace(TINY, scales=(1.0,)))
    assert "scale" not in one_scale.losses(batch, torch.Generator())
    assert {name for name, _ in net_of().named_parameters()} - {name for name, _ in one_scale.named_parameters()} == {
        "scale_bias"
    }


def test_a_batch_is_the_sum_of_its_parts() -> None:
    assert_a_batch_is_the_sum_of_its_parts(net_of(), batch_of([scene(seed) for seed in range(3)]))


def test_bad_images_and_settings_are_refused() -> None:
    net = net_of()
    assert_refuses_bad_images(net, AglNetMatcher(net), scene(0))
    for change, message in (
        ({"coarse_level": 0}, "coarse_level: expected 1 or 2, got 0"),
        ({"scales": ()}, "scales: expected positive numbers"),
        ({"scales": (1.0, -1.0)}, "scales: expected positive numbers"),
    ):
        with pytest.raises(SkyfixError, match=message):
            replace(TINY, **change)
    with pytest.raises(SkyfixError, match="multiple of 16 pixels, got 56"):
        net_of(replace(TINY, bev=replace(BEV, half_extent_m=14.0)))


def test_checkpoints_round_trip(tmp_path: Path) -> None:
    assert_checkpoint_round_trip(ARCHITECTURE, net_of(seed=5), scene(1), tmp_path)


@given(seed=st.integers(0, 10_000), modes=st.integers(0, 4), narrow=st.booleans())
@settings(max_examples=15)
def test_refinement_keeps_every_windows_mass(seed: int, modes: int, narrow: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    coarse, fine = (4 * torch.randn(6, 9, 11, generator=generator, dtype=torch.float64) for _ in range(2))
    yaws = torch.arange(6, dtype=torch.float64) * (2 * math.pi / 6)
    log_widths = torch.randn(6, generator=generator, dtype=torch.float64)
    seen: list[tuple[torch.Tensor, Window]] = []

    def fine_scores(window: Window) -> torch.Tensor:
        inside = torch.zeros_like(coarse, dtype=torch.bool)
        inside[window.headings[:, None, None], :, :] = True
        box = torch.zeros_like(inside)
        box[:, window.rows, window.cols] = True
        seen.append((inside & box, window))
        return fine[window.headings][:, window.rows, window.cols]

    where = RefinementSettings(1.0, 10.0 if narrow else 70.0, modes)
    result = refined(coarse, yaws, log_widths, 2, where, fine_scores)
    width = log_widths[:, None, None]
    covered = torch.zeros_like(coarse, dtype=torch.bool)
    assert len(seen) == modes
    for window, _ in seen:
        new = window & ~covered
        covered |= window
        # The mass is the coarse stage's, its shape the fine stage's.
        before, after = (torch.logsumexp((scores + width)[new], dim=0) for scores in (coarse, result))
        assert float(after) == pytest.approx(float(before), abs=1e-9)
        offset = (result - fine)[new]
        assert float(offset.max() - offset.min()) < 1e-9
    assert torch.equal(result[~covered], coarse[~covered])
    if modes:
        assert bool(seen[0][0].flatten()[coarse.argmax()])


@given(yaw=st.floats(-3.1, 3.1), half_deg=st.floats(12.0, 90.0), seed=st.integers(0, 99))
@settings(max_examples=30)
def test_headings_of_a_window_cover_it_once(yaw: float, half_deg: float, seed: int) -> None:
    quadrature, half = HeadingQuadrature(5, 4.0, 6), math.radians(half_deg)
    yaws, widths = headings_within(quadrature, yaw, half, torch.Generator().manual_seed(seed))
    assert float(widths.sum()) == pytest.approx(2 * half, rel=1e-4)
    assert float((yaws - yaw).abs().max()) <= half + 1e-4
    assert float(yaws[:5].min()) <= yaw + 1e-6 <= float(yaws[:5].max()) + 2e-6


def blob(rows: int, cols: int, row: float, col: float) -> torch.Tensor:
    r, c = torch.arange(rows)[:, None] + 0.5, torch.arange(cols)[None] + 0.5
    return torch.exp(-((r - row) ** 2 + (c - col) ** 2) / (2 * 1.5**2))[None, None]


def centroid(image: torch.Tensor) -> tuple[float, float]:
    plane = image[0, 0]
    r, c = torch.arange(plane.shape[0]) + 0.5, torch.arange(plane.shape[1]) + 0.5
    total = plane.sum()
    return float((plane.sum(1) * r).sum() / total), float((plane.sum(0) * c).sum() / total)


@pytest.mark.parametrize("yaw", QUADRANTS)
@pytest.mark.parametrize("scale", [0.8, 1.0, 1.25])
def test_a_map_seen_from_a_pose_shows_what_is_ahead_ahead(yaw: float, scale: float) -> None:
    """A block 7 cells ahead and 4 to the left, drawn on a map of another scale, is seen 7 ahead and 4 left."""
    row, col, ahead, left = 33.3, 41.8, 7.0, 4.0
    down = -scale * (math.sin(yaw) * ahead + math.cos(yaw) * left)
    right = scale * (math.cos(yaw) * ahead - math.sin(yaw) * left)
    image = blob(70, 90, row + down, col + right)
    truth = [torch.tensor([value]) for value in (row, col, yaw, scale)]
    found = centroid(seen_from(image, *truth, size=32))
    assert found == pytest.approx((16 - left, 16 + ahead), abs=0.05)


@given(scale=st.floats(0.7, 1.4))
@settings(max_examples=10)
def test_scaling_a_scan_and_a_map_move_things_alike(scale: float) -> None:
    """What is d from the vehicle in the scan is s d from it on the map, and the vehicle stays where it is."""
    scales = torch.tensor([scale])
    scan = centroid(scaled_scans(blob(40, 40, 20 - 6, 20 + 9), scales))
    assert scan == pytest.approx((20 - 6 * scale, 20 + 9 * scale), abs=0.05)
    place = centroid(scaled_maps(blob(60, 80, 30 - 6, 44 + 9), torch.tensor([30.0]), torch.tensor([44.0]), scales))
    assert place == pytest.approx((30 - 6 * scale, 44 + 9 * scale), abs=0.05)


def test_a_skeleton_is_where_something_stands() -> None:
    one = scene(3)
    density = batch_of([one]).density
    skeleton, observed = skeleton_targets(density, 2)
    raised = torch.nn.functional.max_pool2d(density[:, 1:].amax(dim=1), 2) > 0
    assert skeleton.shape == observed.shape == (1, BEV.size // 2, BEV.size // 2)
    assert bool((raised | (skeleton == 0)).all())
    assert bool((observed | (skeleton == 0)).all())
    assert 0 < float(skeleton.mean()) <= float(raised.float().mean())


def test_skeleton_loss_is_least_where_both_skeletons_are_the_scans() -> None:
    skeleton, observed = skeleton_targets(batch_of([scene(3)]).density, 2)
    right = 20 * (2 * skeleton - 1)
    assert float(skeleton_loss(right, right, skeleton, observed)) < 1e-6
    assert float(skeleton_loss(right, -right, skeleton, observed)) > 10
    assert float(skeleton_loss(-right, right, skeleton, observed)) == pytest.approx(1.0, abs=1e-3)
    assert float(skeleton_loss(right, -right, skeleton, torch.zeros_like(observed))) == 0.0


def test_the_maps_skeleton_is_asked_for_where_the_scan_has_it() -> None:
    """Seen from its true pose a scene's walls are where the scan's skeleton is; from a pose 3 m off they are not."""
    one = scene(4)
    batch = batch_of([one])
    walls = torch.from_numpy((one.classes > 0).astype(np.float32))[None, None]
    skeleton, observed = skeleton_targets(batch.density, 2)
    half = torch.nn.functional.avg_pool2d(walls, 2) * 8 - 4
    assert half.shape[-1] == CROP_PX // 2

    def loss(off_cells: float) -> float:
        row, col = batch.row / 2 + off_cells, batch.col / 2
        seen = seen_from(half, row, col, batch.yaw, torch.ones(1), skeleton.shape[-1])[:, 0]
        return float(skeleton_loss(seen, seen, skeleton, observed))

    assert loss(0.0) < 0.5 * loss(3.0)
