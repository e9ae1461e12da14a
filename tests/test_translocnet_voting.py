"""TransLocNet's encoders under a vote: the same modules, features on the vote's cells, poses found, a start for it."""

from dataclasses import asdict, replace
from pathlib import Path

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
    scene,
)
from safetensors.torch import load_file

from fusion.errors import SkyfixError
from learned.architectures import ARCHITECTURES
from learned.backbone import BackboneSettings
from learned.calibration import Calibration
from learned.checkpoint import InitialWeights, load_initial, save_network
from learned.training_settings import NetworkChoice, TrainingSettings
from learned.training_state import TrainingState
from learned.translocnet_voting import ARCHITECTURE, EncoderVoteMatcher, EncoderVoteNet, EncoderVoteSettings

BACKBONE = BackboneSettings(8, 5, 1, (8, 8, 16, 16), (1, 1, 1, 1))
TINY = EncoderVoteSettings(4, 64, 2, BACKBONE, BEV, QUICK)
COMPACT = ARCHITECTURES["translocnet-compact"]


def net_of(settings: EncoderVoteSettings = TINY, seed: int = 0) -> EncoderVoteNet:
    torch.manual_seed(seed)
    return EncoderVoteNet(settings)


def vote_checkpoint(folder: Path, settings: EncoderVoteSettings = TINY) -> Path:
    path = folder / "translocnet-voting.safetensors"
    save_network(path, ARCHITECTURE, net_of(settings, seed=5), Calibration(), {})
    return path


@pytest.mark.parametrize(("crop_px", "pool"), [(64, 2), (96, 2), (128, 1)])
def test_features_lie_on_cells_of_the_stride(crop_px: int, pool: int) -> None:
    """However much is padded around a scan, and whether or not the map's sides fit the coarsest level."""
    stride = pool
    net = net_of(replace(TINY, crop_px=crop_px, pool=pool))
    batch = batch_of([scene(0), scene(1)])
    features = net.features(batch.density, batch.picture[:, :, :80])
    assert features.prior is None
    assert features.scan.shape == (2, 4, 64 // stride, 64 // stride)
    assert features.map.shape == (2, 4, 80 // stride, 96 // stride)
    length = torch.linalg.vector_norm(features.map, dim=1)
    torch.testing.assert_close(length, torch.ones_like(length))


def test_gradients_reach_everything() -> None:
    assert_gradients_reach_everything(net_of(seed=1), batch_of([scene(2), scene(3)]))


def test_a_batch_is_the_sum_of_its_parts() -> None:
    assert_a_batch_is_the_sum_of_its_parts(net_of(), batch_of([scene(4), scene(5), scene(6)]))


def test_it_finds_poses_that_it_learned() -> None:
    """The scan has zeros around it; were it not where they end, no heading would agree with another."""
    scenes = [scene(7 + index, yaw) for index, yaw in enumerate(QUADRANTS)]
    net = net_of(replace(TINY, crop_px=96), seed=3)
    losses = fit(net, batch_of(scenes), 120)
    assert losses[0] > BLIND_NLL - 1.0
    assert losses[-1] < BLIND_NLL - 4.0
    for one in scenes:
        assert_finds(EncoderVoteMatcher(net), one, 1.0, 4.0)
    assert net.reaching(24.0).scan_features(torch.zeros(1, 4, 96, 96)).shape[-1] == 48


def test_bad_images_are_named() -> None:
    net = net_of()
    assert_refuses_bad_images(net, EncoderVoteMatcher(net), scene(2))


def test_a_checkpoint_round_trips(tmp_path: Path) -> None:
    assert_checkpoint_round_trip(ARCHITECTURE, net_of(), scene(3), tmp_path)


def test_translocnet_starts_from_its_encoders(tmp_path: Path) -> None:
    """Both encoders are taken over, of all else nothing; the defaults of the two are of the same encoders."""
    path = vote_checkpoint(tmp_path, EncoderVoteSettings())
    pretrained = load_file(path)
    settings = TrainingSettings(network=NetworkChoice("translocnet-compact"), ema_decay=0.9)
    state, fresh = TrainingState(settings, torch.device("cpu")), TrainingState(settings, torch.device("cpu"))
    state.start_from(load_initial(path, COMPACT))
    for net in (state.net, state.evaluated):
        for name, value in net.state_dict().items():
            taken = name.startswith(("map_encoder.", "scan_encoder."))
            assert torch.equal(value, pretrained[name] if taken else fresh.net.state_dict()[name]), name


def test_encoders_of_other_sizes_and_other_networks_are_refused(tmp_path: Path) -> None:
    state = TrainingState(TrainingSettings(network=NetworkChoice("translocnet-compact")), torch.device("cpu"))
    with pytest.raises(SkyfixError, match="the initial weights do not fit the network"):
        state.start_from(load_initial(vote_checkpoint(tmp_path), COMPACT))
    with pytest.raises(SkyfixError, match="expected architecture hybrid-1, got translocnet-voting-1"):
        load_initial(vote_checkpoint(tmp_path), ARCHITECTURES["hybrid"])


def test_a_checkpoint_of_the_network_itself_has_to_hold_all_of_it() -> None:
    """Parts alone are taken from what pre-trains it, and from nothing else."""
    state = TrainingState(TrainingSettings(network=NetworkChoice("translocnet-voting")), torch.device("cpu"))
    whole = state.net.state_dict()
    state.start_from(InitialWeights(whole))
    with pytest.raises(SkyfixError, match="the initial weights do not fit the network"):
        state.start_from(InitialWeights({name: value for name, value in whole.items() if name != "log_scale"}))


def test_settings_are_read_back() -> None:
    choice = NetworkChoice.parse({"architecture": "translocnet-voting", **asdict(TINY)})
    assert choice.settings == TINY
