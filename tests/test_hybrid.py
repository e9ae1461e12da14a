"""The hybrid: each switch takes away what its name says and nothing else, and nothing in it knows the heading."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from landmark_scenes import (
    BEV,
    BLIND_NLL,
    QUADRANTS,
    QUICK,
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
from learned.hybrid import ARCHITECTURE, HybridMatcher, HybridNet, HybridSettings, regression_loss
from learned.set_attention import BidirectionalSetAttention, RingSpectrum
from learned.voting_net import Vote

FULL = HybridSettings(4, (8, 8, 8, 8), attention_heads=2, embedding=8, bev=BEV, quadrature=QUICK)
SWITCHES: dict[str, tuple[dict[str, bool | float], tuple[str, ...]]] = {
    "cross_attention": ({"cross_attention": False}, ("attention.",)),
    "multi_scale": ({"multi_scale": False}, ("scan_head.coarser.", "map_head.coarser.")),
    "fourier": ({"fourier": False}, ("spectrum.",)),
    "scan_worth": ({"scan_worth": False}, ("worth_head.",)),
    "map_prior": ({"map_prior": False}, ("prior_head.",)),
    "learned_temperature": ({"learned_temperature": False}, ("log_scale",)),
    "contrastive_weight": ({"contrastive_weight": 0.0}, ("scan_projection.", "map_projection.")),
    "regression_weight": ({"regression_weight": 0.0}, ()),
}
"""Switch -> how it is turned off, and the parameters that go with it."""
FEATURES = [name for name in SWITCHES if not name.endswith("_weight")]


def net_of(settings: HybridSettings = FULL, seed: int = 0) -> HybridNet:
    torch.manual_seed(seed)
    return HybridNet(settings)


def without(name: str) -> HybridSettings:
    return replace(FULL, **SWITCHES[name][0])


@pytest.mark.parametrize("name", SWITCHES)
def test_a_switch_takes_its_own_parameters_away_and_no_others(name: str) -> None:
    full, less = (dict(net_of(settings).named_parameters()) for settings in (FULL, without(name)))
    gone = set(full) - set(less)
    assert set(less) <= set(full)
    assert gone == {parameter for parameter in full if parameter.startswith(SWITCHES[name][1] or ("none",))}
    assert all(full[parameter].shape == less[parameter].shape for parameter in less)


@pytest.mark.parametrize("name", FEATURES)
def test_a_part_of_zero_weights_is_a_part_that_is_not_there(name: str) -> None:
    """With the part's parameters at zero the full network's scores are those of the network without the part."""
    full = net_of(seed=2).eval()
    less = HybridNet(without(name)).eval()
    less.load_state_dict({key: value for key, value in full.state_dict().items() if key in less.state_dict()})
    batch = batch_of([scene(1)])
    yaws = torch.tensor([0.0, 2.0])
    with torch.inference_mode():
        if name == "learned_temperature":
            full.log_scale.fill_(0.7)
        with_part = full.pose_scores(batch.density[0], batch.picture[0], yaws)
        alone = less.pose_scores(batch.density[0], batch.picture[0], yaws)
        for key, parameter in full.named_parameters():
            if key.startswith(SWITCHES[name][1]):
                parameter.zero_()
        emptied = full.pose_scores(batch.density[0], batch.picture[0], yaws)
    assert float((with_part - alone).abs().max()) > 1e-4
    torch.testing.assert_close(emptied, alone, rtol=1e-4, atol=1e-4)


def test_the_weights_of_losses_are_what_they_say() -> None:
    batch = batch_of([scene(0), scene(1), scene(2)])

    def terms(settings: HybridSettings) -> dict[str, float]:
        net = net_of(FULL)
        other = HybridNet(settings)
        other.load_state_dict({k: v for k, v in net.state_dict().items() if k in other.state_dict()})
        return {k: float(v.detach()) for k, v in other.losses(batch, torch.Generator().manual_seed(1)).items()}

    full = terms(FULL)
    assert set(full) == {"total", "nll", "regression", "contrastive"}
    assert full["total"] == pytest.approx(full["nll"] + 0.1 * full["regression"] + 0.1 * full["contrastive"], rel=1e-5)
    for name, term in (("contrastive_weight", "contrastive"), ("regression_weight", "regression")):
        less = terms(without(name))
        assert term not in less
        assert less["total"] == pytest.approx(full["total"] - 0.1 * full[term], rel=1e-5)
    mean_alone = terms(replace(FULL, likelihood_weight=0.0))
    assert mean_alone["total"] == pytest.approx(full["total"] - full["nll"], rel=1e-4)


@pytest.mark.parametrize("name", ["none", *SWITCHES])
def test_gradients_reach_every_parameter_under_each_switch(name: str) -> None:
    settings = FULL if name == "none" else without(name)
    assert_gradients_reach_everything(net_of(settings), batch_of([scene(0), scene(1)]))


def test_a_batch_of_one_trains_and_has_nothing_to_contrast() -> None:
    net = net_of()
    terms = net.losses(batch_of([scene(0)]), torch.Generator().manual_seed(1))
    assert float(terms["contrastive"].detach()) == pytest.approx(0.0, abs=1e-6)
    terms["total"].backward()
    assert all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in net.parameters())
    assert_gradients_reach_everything(net_of(without("contrastive_weight")), batch_of([scene(0)]))


def test_scans_of_one_place_are_not_contrasted() -> None:
    batch = batch_of([scene(0), scene(1)])
    near, far = (torch.tensor([[0.0, 0.0], [metres, 0.0]], dtype=torch.float64) for metres in (5.0, 50.0))
    terms = [
        float(net_of().losses(replace(batch, place=place), torch.Generator())["contrastive"].detach())
        for place in (near, far)
    ]
    assert terms[0] == pytest.approx(0.0, abs=1e-6)
    assert terms[1] > 0.01


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_attention_reads_the_same_whatever_the_heading(turns: int) -> None:
    """Features of a scan that has been turned: the map reads what it read before, the scan's reading turns along."""
    torch.manual_seed(3)
    attention = BidirectionalSetAttention(8, 12, 2)
    scan, found = torch.randn(2, 8, 6, 6), torch.randn(2, 12, 5, 7)
    with torch.no_grad():
        read_scan, read_map = attention(scan, found)
        turned_scan, turned_map = attention(torch.rot90(scan, turns, (2, 3)), found)
    assert read_scan.shape == scan.shape
    assert read_map.shape == found.shape
    torch.testing.assert_close(turned_map, read_map, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(turned_scan, torch.rot90(read_scan, turns, (2, 3)), rtol=1e-4, atol=1e-5)
    with torch.no_grad():
        _, other_map = attention(torch.randn(2, 8, 6, 6), found)
    assert float((other_map - read_map).abs().max()) > 1e-3


def test_the_spectrum_knows_neither_place_nor_heading() -> None:
    torch.manual_seed(4)
    spectrum = RingSpectrum(3, 5)
    image = torch.randn(1, 3, 16, 16)
    with torch.no_grad():
        found = spectrum(image)
        torch.testing.assert_close(spectrum(torch.rot90(image, 1, (2, 3))), found, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(spectrum(image.roll((3, 5), (2, 3))), found, rtol=1e-4, atol=1e-5)
        assert float((spectrum(image.cumsum(3)) - found).abs().max()) > 1e-2
        # Texture of one kind says the same of images of any size.
        large = spectrum(torch.randn(1, 3, 128, 128))
    assert float((large - found).abs().max()) < 0.25


def test_the_mean_pose_of_a_sharp_vote_is_its_peak() -> None:
    scores = torch.full((4, 9, 11), -60.0)
    scores[2, 3, 7] = 0.0
    yaws, widths = torch.tensor([0.0, 1.0, 2.0, 3.0]), torch.ones(4)
    at_peak = Vote(scores, yaws, widths, (3.0, 7.0, 2.0), torch.zeros(()))
    assert float(regression_loss(at_peak, 1.0)) == pytest.approx(0.0, abs=1e-6)
    # Huber, delta 1: 3 m off costs 2.5, half a metre 0.125, and 0.1 rad on an arm of 10 m costs 0.5.
    off = at_peak._replace(truth=(4.5, 6.75, 2.1))
    assert float(regression_loss(off, 2.0)) == pytest.approx(2.5 + 0.125 + 0.5, rel=1e-3)
    around = at_peak._replace(truth=(3.0, 7.0, 2.0 - 2 * np.pi))
    assert float(regression_loss(around, 1.0)) == pytest.approx(0.0, abs=1e-6)


def test_learns_scenes_and_finds_their_poses_in_all_quadrants() -> None:
    scenes = [scene(seed, yaw) for seed, yaw in enumerate(QUADRANTS)]
    net = net_of()
    fit(net, batch_of(scenes), 16)
    with torch.inference_mode():
        nll = net.truth_nll(batch_of(scenes), torch.Generator().manual_seed(0))
    assert float(nll.max()) < BLIND_NLL - 5.0
    for one in scenes:
        assert_finds(HybridMatcher(net, yaw_bins=72), one, metres=1.0, degrees=5.0)


def test_a_batch_is_the_sum_of_its_parts() -> None:
    assert_a_batch_is_the_sum_of_its_parts(net_of(), batch_of([scene(seed) for seed in range(3)]))


def test_bad_images_are_refused() -> None:
    net = net_of()
    assert_refuses_bad_images(net, HybridMatcher(net), scene(0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"attention_heads": 3}, "attention_heads: expected a divisor of 8, got 3"),
        ({"contrastive_weight": -1.0}, "contrastive_weight: expected zero or more"),
        ({"regression_weight": float("nan")}, "regression_weight: expected zero or more"),
        ({"likelihood_weight": -0.5}, "likelihood_weight: expected zero or more, got -0.5"),
        ({"likelihood_weight": 0.0, "regression_weight": 0.0}, "a likelihood_weight or a regression_weight above zero"),
    ],
)
def test_bad_settings_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(SkyfixError, match=message):
        replace(FULL, **change)
    with pytest.raises(SkyfixError, match="widths: expected multiples of 4"):
        HybridNet(replace(FULL, widths=(8, 8, 10, 8)))


def test_checkpoints_round_trip(tmp_path: Path) -> None:
    assert_checkpoint_round_trip(ARCHITECTURE, net_of(seed=5), scene(1), tmp_path)


def test_a_longer_reach_uses_the_same_weights() -> None:
    near = net_of()
    far = near.reaching(20.0)
    for (name, a), (other, b) in zip(near.state_dict().items(), far.state_dict().items(), strict=True):
        assert name == other
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    one = scene(0)
    padded = np.zeros((4, 80, 80), np.float32)
    padded[:, 8:72, 8:72] = one.counts
    volume = matched(HybridMatcher(far, yaw_bins=8), replace(one, counts=padded), half_extent_m=3.0)
    assert volume.grid.contains(one.pose[:2])
