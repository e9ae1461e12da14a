"""Training serves any network of the interface: here the least one there can be, from settings to checkpoint."""

from __future__ import annotations

import csv
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from guess_network import GUESS, GuessNet, GuessSettings
from landmarks import Landmarks

from fusion.errors import SkyfixError
from learned.architectures import ARCHITECTURES
from learned.calibration import Calibration, match_samples
from learned.checkpoint import load_checkpoint, load_network, save_network
from learned.matcher import load_matcher
from learned.rotmatch import RotMatchSettings
from learned.training import NetworkChoice, TrainingSettings, train
from learned.training_state import TrainingState

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def with_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ARCHITECTURES, "guess", GUESS)


def guess_settings(steps: int = 6, **network: float) -> TrainingSettings:
    choice = NetworkChoice("guess", GuessSettings(**network))
    return TrainingSettings(steps, 2, 0.1, warmup_steps=1, validate_every=2, workers=0, network=choice)


def test_a_network_nobody_knew_learns_the_spread_of_what_it_is_given(tmp_path: Path) -> None:
    settings = replace(guess_settings(60), batch=8, validate_every=60)
    settings = replace(settings, augmentation=replace(settings.augmentation, half_heading_deg=20.0))
    net = train(Landmarks(8), Landmarks(2), settings, tmp_path)
    assert isinstance(net, GuessNet)
    # Offsets uniform within 40 pixels of half a metre, headings within 20 degrees.
    assert math.exp(float(net.log_sigma.detach())) == pytest.approx(20 / math.sqrt(3), rel=0.25)
    assert math.exp(-0.5 * float(net.log_kappa.detach())) == pytest.approx(math.radians(20 / math.sqrt(3)), rel=0.35)


def test_every_term_is_logged_and_dropped_rows_are_written_again(tmp_path: Path) -> None:
    train(Landmarks(3), Landmarks(1), guess_settings(), tmp_path)
    log = tmp_path / "loss.csv"
    straight = log.read_text()
    rows = list(csv.DictReader(straight.splitlines()))
    assert [row["step"] for row in rows] == ["2", "4", "6"]
    for row in rows:
        assert float(row["loss"]) == pytest.approx(float(row["position"]) + float(row["heading"]), abs=2e-4)
    # As a kill leaves it: the state of step 4 and the row of step 6.
    (tmp_path / "state.pt").unlink()
    stopped = tmp_path / "stopped"

    def stop(step: int, steps: int, loss: float, validation: float | None) -> None:
        if step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(Landmarks(3), Landmarks(1), guess_settings(), stopped, stop)
    (stopped / "loss.csv").write_text(straight)
    train(Landmarks(3), Landmarks(1), guess_settings(), stopped)
    again = list(csv.DictReader((stopped / "loss.csv").read_text().splitlines()))
    timeless = [{k: v for k, v in row.items() if k != "seconds"} for row in (*rows, *again)]
    assert timeless[:3] == timeless[3:]


def test_workers_change_nothing(tmp_path: Path) -> None:
    alone = train(Landmarks(5), Landmarks(1), guess_settings(), tmp_path / "alone")
    helped = train(Landmarks(5), Landmarks(1), replace(guess_settings(), workers=2), tmp_path / "helped")
    torch.testing.assert_close(helped.state_dict(), alone.state_dict(), rtol=0, atol=0)
    # A finished training is only loaded, whatever the workers.
    again = train(Landmarks(5), Landmarks(1), replace(guess_settings(), workers=1), tmp_path / "alone")
    torch.testing.assert_close(again.state_dict(), alone.state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("precision", ["bfloat16", "float32"])
def test_precision_decides_on_autocast_in_training_alone(tmp_path: Path, precision: str) -> None:
    settings = replace(guess_settings(2), precision=precision)
    net = train(Landmarks(2), Landmarks(1), settings, tmp_path)
    assert isinstance(net, GuessNet)
    assert net.autocast == [precision == "bfloat16"] * 2


def test_the_moving_average_is_what_is_kept(tmp_path: Path) -> None:
    settings = replace(guess_settings(), ema_decay=0.75)
    state = TrainingState(settings, CPU)
    assert isinstance(state.net, GuessNet)
    assert isinstance(state.average, GuessNet)
    expected = float(state.net.log_sigma.detach())
    for _ in range(5):
        state.advance(state.net.log_sigma**2)
        expected = 0.75 * expected + 0.25 * float(state.net.log_sigma.detach())
    assert float(state.average.log_sigma.detach()) == pytest.approx(expected, abs=1e-6)
    kept = train(Landmarks(3), Landmarks(1), settings, tmp_path)
    plain = train(Landmarks(3), Landmarks(1), guess_settings(), tmp_path / "plain")
    last = torch.load(tmp_path / "state.pt", weights_only=True)
    torch.testing.assert_close(last["average"], kept.state_dict(), rtol=0, atol=0)
    torch.testing.assert_close(last["net"], plain.state_dict(), rtol=0, atol=0)
    assert float(last["net"]["log_sigma"]) != float(last["average"]["log_sigma"])


def test_gradients_are_clipped_and_the_rate_follows_the_schedule() -> None:
    settings = replace(guess_settings(10), clip_norm=0.5, warmup_steps=4)
    state = TrainingState(settings, CPU)
    assert isinstance(state.net, GuessNet)
    assert state.advance(1000 * state.net.log_sigma) == pytest.approx(1000.0)
    assert float(state.net.log_sigma.grad) == pytest.approx(0.5, rel=1e-5)
    assert [settings.rate(step) for step in (0, 3, 10)] == pytest.approx([0.25, 0.5 * (1 + math.cos(0.3 * math.pi)), 0])
    before = float(state.net.log_sigma.detach())
    with pytest.raises(SkyfixError, match="finite gradient, got a norm of inf at step 1"):
        state.advance(float("inf") * state.net.log_sigma)
    assert float(state.net.log_sigma.detach()) == before


def test_a_loss_that_is_not_finite_stops_with_the_step_and_the_terms(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match=r"finite loss, got nan at step \d+ \(position .*, heading .*\)") as caught:
        train(Landmarks(2), Landmarks(1), guess_settings(200, poison_at=2.0), tmp_path)
    assert "\n" not in str(caught.value)
    assert torch.isfinite(torch.load(tmp_path / "state.pt", weights_only=True)["net"]["log_sigma"])


def test_an_output_folder_that_cannot_be_one_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SkyfixError, match=r"file/out: expected a folder to write to: Not a directory"):
        train(Landmarks(2), Landmarks(1), guess_settings(), tmp_path / "file" / "out")


def test_a_folder_of_another_architecture_or_a_broken_state_is_refused(tmp_path: Path) -> None:
    train(Landmarks(2), Landmarks(1), guess_settings(2), tmp_path)
    other = replace(guess_settings(2), network=NetworkChoice("rotmatch", RotMatchSettings(4, (4, 4, 8, 8))))
    with pytest.raises(SkyfixError, match="made with other settings"):
        train(Landmarks(2), Landmarks(1), other, tmp_path)
    state = tmp_path / "state.pt"
    for content in (b"", b"not a state", state.read_bytes()[:300]):
        state.write_bytes(content)
        with pytest.raises(SkyfixError, match=r"state\.pt cannot be read, delete it") as caught:
            train(Landmarks(2), Landmarks(1), guess_settings(2), tmp_path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "training steps: expected a number above zero, got 0"),
        ({"learning_rate": math.nan}, "training learning_rate: expected a number above zero, got nan"),
        ({"workers": -1}, "training workers: expected zero or more, got -1"),
        ({"ema_decay": 1.0}, "training ema_decay: expected between 0 and 1"),
    ],
)
def test_bad_settings_are_named(change: dict[str, float], message: str) -> None:
    with pytest.raises(SkyfixError, match=message):
        replace(guess_settings(), **change)


def test_a_choice_of_network_says_what_is_wrong() -> None:
    assert NetworkChoice.parse({"architecture": "guess", "dropout": 0.5}).settings == GuessSettings(dropout=0.5)
    assert NetworkChoice.parse({"channels": 4}) == NetworkChoice("rotmatch", RotMatchSettings(4))
    choice = NetworkChoice("guess", GuessSettings(dropout=0.5))
    assert NetworkChoice.parse(choice.as_mapping()) == choice
    for content, message in (
        ({"architecture": "gess"}, r"expected one of .*rotmatch.*guess, got 'gess'"),
        ({"architecture": "guess", "channels": 4}, "guess settings: channels: Unexpected"),
        ({"architecture": "guess", "bev": {"half_extent_m": "far"}}, r"guess settings: bev\.half_extent_m: .*'far'"),
        ("guess", "expected a mapping with an architecture, got 'guess'"),
    ):
        with pytest.raises(SkyfixError, match=message):
            NetworkChoice.parse(content)
    with pytest.raises(SkyfixError, match="network guess: expected GuessSettings, got RotMatchSettings"):
        NetworkChoice("guess", RotMatchSettings())


def test_no_gpu_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SkyfixError, match="expected a GPU that torch can use, found none"):
        train(Landmarks(2), Landmarks(1), replace(guess_settings(), device="cuda"), tmp_path)


def test_missing_tensorboard_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(SkyfixError, match="expected the package tensorboard for --tensorboard, found none"):
        train(Landmarks(2), Landmarks(1), guess_settings(), tmp_path, tensorboard=True)


def test_tensorboard_gets_every_step(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(Landmarks(2), Landmarks(1), guess_settings(4), tmp_path, tensorboard=True)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("training/position")] == [1, 2, 3, 4]
    assert [event.step for event in events.Scalars("validation/nll")] == [2, 4]


def test_a_checkpoint_says_which_network_it_is_of(tmp_path: Path) -> None:
    torch.manual_seed(1)
    net, path = GuessNet(GuessSettings(dropout=0.25)), tmp_path / "net.safetensors"
    save_network(path, GUESS, net, Calibration(2.0, 7.0, 1.5, 0.8, -0.3), {"seed": 1})
    matcher = load_matcher(str(path))
    assert matcher.name == "guess"
    assert matcher.error_correlation_length_m == 7.0
    again, calibration = load_network(path, GUESS)
    assert again.settings == net.settings
    assert calibration == Calibration(2.0, 7.0, 1.5, 0.8, -0.3)
    torch.testing.assert_close(again.state_dict(), net.state_dict(), rtol=0, atol=0)
    assert json.loads(path.with_suffix(".json").read_text())["architecture"] == "guess-1"
    with pytest.raises(SkyfixError, match="expected architecture rotmatch-1, got guess-1"):
        load_network(path, ARCHITECTURES["rotmatch"])
    del ARCHITECTURES["guess"]
    with pytest.raises(SkyfixError, match=r"expected architecture rotmatch-1.*, got guess-1"):
        load_checkpoint(path)
    ARCHITECTURES["guess"] = GUESS


@pytest.mark.parametrize("content", ["[]", "{", '{"architecture": "guess-1"}', "\xff"])
def test_broken_sidecars_are_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "net.safetensors"
    save_network(path, GUESS, GuessNet(GuessSettings()), Calibration(), {})
    path.with_suffix(".json").write_bytes(content.encode("latin-1"))
    with pytest.raises(SkyfixError, match=r"checkpoint net\.safetensors: expected") as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value)


def test_any_matcher_is_matched_with_samples() -> None:
    matcher = GUESS.matcher(GuessNet(GuessSettings()), Calibration())
    volumes, truths = match_samples(matcher, Landmarks(2).samples, 10.0, 0.2, seed=0)
    for volume, truth in zip(volumes, truths, strict=True):
        assert np.isfinite(volume.log_density(truth[None])).all()
