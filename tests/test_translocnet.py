"""TransLocNet's sizes, switches and gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_translocnet import TINY, noise_batch
from torch import nn

from fusion.errors import SkyfixError
from learned.architectures import ARCHITECTURES, settings_from, settings_mapping
from learned.backbone import BackboneSettings, ResidualEncoder
from learned.decoder import Decoder, Neck
from learned.translocnet import TransLocNet
from learned.translocnet_output import PoseMaps
from learned.translocnet_settings import CompactSettings, LossSettings, TransLocNetSettings

SWITCHES = {
    "all on": TINY,
    "concatenation": replace(TINY, cross_attention=False),
    "single scale": replace(TINY, multi_scale=False),
    "direct regression": replace(TINY, probabilistic=False),
    "no fourier": replace(TINY, fourier="off"),
    "rotation-pooled fourier": replace(TINY, fourier="rotation_pooled"),
    "no regression loss": replace(TINY, loss=LossSettings(regression=0.0)),
    "no contrastive loss": replace(TINY, loss=LossSettings(contrastive=0.0)),
}
ALL_TERMS = {"total", "location", "orientation", "regression", "contrastive", "confidence"}


def count(*modules: nn.Module | None) -> int:
    return sum(p.numel() for module in modules if module is not None for p in module.parameters())


def shapes(settings: TransLocNetSettings) -> dict[str, torch.Size]:
    return {name: p.shape for name, p in TransLocNet(settings).named_parameters()}


def test_parameters_of_every_stage_are_the_papers() -> None:
    net = TransLocNet(TransLocNetSettings())
    assert count(net.map_encoder) == 21_284_672  # ResNet-34 without its classifier, to the last weight
    assert count(net.scan_encoder) == 21_278_400
    stages = {
        "neck of the map": (count(net.map_neck), 0.71e6),
        "neck of the scan": (count(net.scan_neck), 0.71e6),
        "fourier": (count(net.fourier), 0.033e6),
        "attention": (count(net.attention), 0.40e6),
        "fusion": (count(net.fusion), 0.44e6),
        "decoder": (count(net.decoder), 0.32e6),
        "heads": (count(net.heads, net.confidence, net.map_projection, net.scan_projection), 0.063e6),
        "all": (count(net), 45.3e6),
    }
    for stage, (have, expected) in stages.items():
        assert have == pytest.approx(expected, rel=0.025), stage


def test_compact_has_between_two_and_three_million_and_as_many_tokens() -> None:
    settings = CompactSettings()
    assert 2.0e6 < count(TransLocNet(settings)) < 3.0e6
    assert settings.side == TransLocNetSettings().side == 16
    assert (settings.cells, settings.cell_m) == (128, 1.0)


def test_shapes_of_every_stage_at_256_pixels() -> None:
    settings = TransLocNetSettings()
    with torch.device("meta"):
        picture, tokens = torch.empty(2, 3, 256, 256), torch.empty(2, 128, 16, 16)
        levels = ResidualEncoder(3, settings.backbone)(picture)
        assert [tuple(level.shape[1:]) for level in levels] == [
            (64, 128, 128), (64, 64, 64), (128, 32, 32), (256, 16, 16), (512, 8, 8),
        ]  # fmt: skip
        assert Neck(settings.backbone, 128, True)(levels).shape == tokens.shape
        assert Neck(settings.backbone, 128, False)(levels).shape == tokens.shape
        decoder = Decoder(settings.backbone, 128, settings.decoder_widths)
        assert decoder(tokens, levels).shape == (2, 32, 256, 256)


@pytest.mark.parametrize("name", SWITCHES)
def test_every_switch_gives_finite_losses_and_a_gradient_to_every_parameter(name: str) -> None:
    torch.manual_seed(0)
    net = TransLocNet(SWITCHES[name]).train()
    losses = net.losses(noise_batch(4), torch.Generator())
    losses["total"].backward()
    assert all(torch.isfinite(term) for term in losses.values())
    for parameter_name, parameter in net.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert torch.isfinite(parameter.grad).all(), parameter_name
        assert parameter.grad.abs().max() > 0, parameter_name


@pytest.mark.parametrize(
    ("name", "removed", "added", "reshaped", "terms_removed"),
    [
        ("concatenation", ["attention."], [], [], set()),
        (
            "single scale",
            ["map_neck.lateral.", "scan_neck.lateral."],
            [],
            ["map_neck.lateral.0.", "scan_neck.lateral.0.", "map_neck.mix.0.0.", "scan_neck.mix.0.0."],
            set(),
        ),
        ("direct regression", ["decoder.", "heads."], ["regression."], ["confidence."], {"location", "orientation"}),
        ("no fourier", ["fourier."], [], [], set()),
        ("rotation-pooled fourier", [], [], [], set()),
        ("no regression loss", [], [], [], {"regression"}),
        ("no contrastive loss", ["map_projection.", "scan_projection."], [], [], {"contrastive"}),
    ],
)
def test_switches_change_what_they_say_and_nothing_else(
    name: str, removed: list[str], added: list[str], reshaped: list[str], terms_removed: set[str]
) -> None:
    base, other = shapes(TINY), shapes(SWITCHES[name])
    gone, new = base.keys() - other.keys(), other.keys() - base.keys()
    changed = {key for key in base.keys() & other.keys() if base[key] != other[key]}
    for have, prefixes in ((gone, removed), (new, added), (changed, reshaped)):
        assert all(key.startswith(tuple(prefixes)) for key in have)
        assert all(any(key.startswith(prefix) for key in have) for prefix in prefixes)
    torch.manual_seed(0)
    assert TransLocNet(SWITCHES[name]).losses(noise_batch(), torch.Generator()).keys() == ALL_TERMS - terms_removed


def test_pooling_the_spectrum_over_rotations_changes_the_answer() -> None:
    answers = []
    for fourier in ("spectrum", "rotation_pooled"):
        torch.manual_seed(0)
        answers.append(TransLocNet(replace(TINY, fourier=fourier)).truth_nll(noise_batch(), torch.Generator()))
    assert not torch.allclose(*answers)


def test_the_sensitivity_grid_weighs_the_same_terms() -> None:
    batch = noise_batch(2)
    for lambda_1 in (0.5, 1.0, 2.0, 4.0):
        for lambda_2 in (0.05, 0.1, 0.2, 0.5):
            torch.manual_seed(0)
            loss = LossSettings(regression=lambda_1, contrastive=lambda_2)
            with torch.no_grad():
                terms = TransLocNet(replace(TINY, loss=loss)).losses(batch, torch.Generator())
            plain = terms["location"] + terms["orientation"] + 0.1 * terms["confidence"]
            expected = plain + lambda_1 * terms["regression"] + lambda_2 * terms["contrastive"]
            torch.testing.assert_close(terms["total"], expected)


def test_the_confidence_shapes_no_feature_and_the_contrast_no_attention() -> None:
    torch.manual_seed(0)
    net = TransLocNet(TINY)
    terms = net.losses(noise_batch(), torch.Generator())

    def reached(term: str) -> set[str]:
        names, parameters = zip(*net.named_parameters(), strict=True)
        gradients = torch.autograd.grad(terms[term], parameters, retain_graph=True, allow_unused=True)
        return {
            name.split(".")[0] for name, g in zip(names, gradients, strict=True) if g is not None and g.abs().max() > 0
        }

    assert reached("confidence") == {"confidence"}
    encoders = {"map_encoder", "scan_encoder", "map_neck", "scan_neck", "fourier"}
    assert reached("contrastive") == encoders | {"map_projection", "scan_projection"}
    assert reached("location") == encoders | {"attention", "fusion", "decoder", "heads"}


@pytest.mark.parametrize("name", SWITCHES)
def test_one_sample_answers_as_it_does_among_others(name: str) -> None:
    """Nothing is normalised over the batch, so a batch of one trains too."""
    torch.manual_seed(0)
    net, batch = TransLocNet(SWITCHES[name]).train(), noise_batch(3)
    alone = replace(
        batch, **{k: getattr(batch, k)[1:2] for k in ("density", "picture", "row", "col", "yaw", "prior_yaw")}
    )
    with torch.no_grad():
        together, single = (net.truth_nll(b, torch.Generator()) for b in (batch, alone))
        torch.testing.assert_close(single[0], together[1], rtol=1e-4, atol=1e-4)
    net.losses(alone, torch.Generator())["total"].backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_embeddings_are_those_of_the_loss() -> None:
    torch.manual_seed(0)
    net, batch = TransLocNet(TINY).eval(), noise_batch(3)
    with torch.no_grad():
        scans = net.scan_embedding(batch.density, batch.prior_yaw)
        maps = net.map_embedding(batch.picture)
        output = net(batch.density, batch.picture, batch.prior_yaw)
        assert net.scan_projection is not None
        torch.testing.assert_close(scans, net.scan_projection(output.pooled_scan))
        unturned = net.scan_embedding(batch.density)
    assert scans.shape == maps.shape == (3, TINY.embedding)
    for vectors in (scans, maps, unturned):
        torch.testing.assert_close(vectors.norm(dim=1), torch.ones(3))
    assert (scans - unturned).abs().max() > 1e-4
    without = TransLocNet(SWITCHES["no contrastive loss"])
    with pytest.raises(SkyfixError, match="expected a network with a contrastive loss"):
        without.map_embedding(batch.picture)


def test_training_under_autocast_keeps_the_losses() -> None:
    torch.manual_seed(0)
    net, batch = TransLocNet(TINY), noise_batch()
    plain = net.losses(batch, torch.Generator())
    with torch.autocast("cpu", torch.bfloat16):
        coarse = net.losses(batch, torch.Generator())
    for name, term in coarse.items():
        assert term.dtype == torch.float32
        torch.testing.assert_close(term, plain[name], rtol=0.1, atol=0.05)


def test_settings_survive_a_configuration_file() -> None:
    for name, settings in (("translocnet", TINY), ("translocnet-compact", CompactSettings(fourier="off"))):
        content = settings_mapping(ARCHITECTURES[name], settings)
        content.pop("architecture")
        content["decoder_widths"] = list(content["decoder_widths"])
        assert settings_from(ARCHITECTURES[name], content) == settings
    with pytest.raises(SkyfixError, match="fourier"):
        settings_from(ARCHITECTURES["translocnet"], {"fourier": "yes"})


def test_wrong_inputs_are_one_line() -> None:
    net, batch = TransLocNet(TINY), noise_batch(2)
    with pytest.raises(SkyfixError, match=r"^map picture: expected \(B, 3, 64, 64\), got \(2, 3, 64, 32\)$"):
        net(batch.density, batch.picture[..., :32], batch.prior_yaw)
    with pytest.raises(SkyfixError, match=r"^map picture: expected finite values, got NaN or an infinity$"):
        net(batch.density, batch.picture * torch.nan, batch.prior_yaw)
    with pytest.raises(SkyfixError, match=r"^scan density: expected finite values, got 18432 of 18432 not finite$"):
        net(batch.density * torch.nan, batch.picture, batch.prior_yaw)
    with pytest.raises(SkyfixError, match=r"^batch: expected 0.5 m a pixel, got 0.2$"):
        net.losses(replace(batch, metres_per_pixel=0.2), torch.Generator())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"crop_px": 72}, "expected a crop of a multiple of 16 pixels, got 72"),
        ({"channels": 20}, "expected a multiple of 8, got 20"),
        ({"heads": 3}, "expected channels a multiple of heads, got 16, 3"),
        ({"uniform_floor": 1.0}, r"expected a uniform floor in \[0, 1\), got 1.0"),
        ({"probabilistic": False, "loss": LossSettings(regression=0.0)}, "got neither"),
    ],
)
def test_settings_that_make_no_network_are_one_line(change: dict[str, object], message: str) -> None:
    with pytest.raises(SkyfixError, match=message):
        replace(TINY, **change)
    with pytest.raises(SkyfixError, match="encoder width: expected a multiple of 8, got 12"):
        BackboneSettings(stem_width=12)
    with pytest.raises(SkyfixError, match="expected none below 0"):
        LossSettings(contrastive=-0.1)
    with pytest.raises(SkyfixError, match="expected widths, units and counts above 0, got 0"):
        LossSettings(hard_negatives=0)


def test_features_are_as_fine_as_the_map() -> None:
    net, batch = TransLocNet(replace(TINY, pool=2, crop_px=128)), noise_batch(2, replace(TINY, crop_px=128))
    pose = net(batch.density, batch.picture, batch.prior_yaw).pose
    assert isinstance(pose, PoseMaps)
    assert pose.log_location.shape == (2, 64, 64)
