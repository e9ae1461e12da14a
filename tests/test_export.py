"""Exported encoders: the same answers as torch at every size, 8 bits close to it, and folders that cannot be used."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from landmark_scenes import BEV, Scene, matched, scene
from landmarks import Landmarks
from made_drive import MadeDrive

from fusion.errors import SkyfixError
from learned.backends import BACKENDS, Backend, first_installed
from learned.batches import training_batches
from learned.calibration import Calibration
from learned.export import export
from learned.exported import ExportedRotMatch, load_exported
from learned.geometric import GeometricMatcher
from learned.matcher import SearchRegion, load_matcher
from learned.rotmatch import RotMatch, RotMatchNet, RotMatchSettings
from learned.training_settings import TrainingSettings
from learned.voting_net import VotingMatcher
from sequences.cli import main
from sequences.folder import FolderSequence
from sequences.matched_images import matched_images

pytestmark = pytest.mark.skipif(find_spec("onnx") is None, reason="needs the package onnx: skyfix[onnxruntime]")

FP32 = [name for name, backend in BACKENDS.items() if backend.weights == "fp32"]
INT8 = [name for name, backend in BACKENDS.items() if backend.weights == "int8"]
SMALL = RotMatchSettings(4, (4, 4, 8, 8), BEV)


def installed(name: str) -> Backend:
    """The backend, or skip."""
    if not BACKENDS[name].installed:
        pytest.skip(f"{BACKENDS[name].package} is not installed")
    return BACKENDS[name]


def near(one: Scene) -> SearchRegion:
    """Where `landmark_scenes.matched` searches."""
    return SearchRegion(one.pose + [1.0, -1.5, 0.0], 5.0)


def shipped_for_scenes() -> RotMatch:
    """The shipped weights at the reach of the test's scenes."""
    shipped = RotMatch.shipped()
    return RotMatch(shipped.net.reaching(BEV.half_extent_m), shipped.calibration)


def calibration_images(matcher: RotMatch) -> list[tuple[np.ndarray, np.ndarray]]:
    """What the network sees of three scenes."""
    found = []
    for one in (scene(seed) for seed in range(3)):
        density, picture, _ = matcher.images(one.counts, one.raster, SearchRegion(one.pose, 5.0))
        found.append((density.numpy(), picture.numpy()))
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export in 32 bits."""
    out = tmp_path_factory.mktemp("export") / "deep" / "folder"
    assert export(shipped_for_scenes(), out) == out / "export.json"
    return out


@pytest.fixture(scope="module")
def rounded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export with 8-bit graphs."""
    for package in ("onnx", "onnxruntime"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    matcher, out = shipped_for_scenes(), tmp_path_factory.mktemp("rounded")
    export(matcher, out, calibration_images(matcher))
    return out


@pytest.mark.parametrize("name", [name for name in FP32 if name != "openvino-bf16"])
@pytest.mark.parametrize(("batch", "height", "width"), [(1, 64, 64), (3, 96, 64), (2, 80, 208)])
def test_features_are_torch_s_at_every_size(name: str, batch: int, height: int, width: int, folder: Path) -> None:
    net, backend = RotMatch.shipped().net, installed(name)
    scan, picture_graph = ((folder / file).read_bytes() for file in ("scan.onnx", "map.onnx"))
    other = ExportedRotMatch(net.settings, backend.session(scan), backend.session(picture_graph))
    generator = torch.Generator().manual_seed(batch)
    density = torch.rand(batch, 4, height, width, generator=generator)
    picture = torch.rand(batch, 3, height, width, generator=generator)
    with torch.inference_mode():
        pairs = [
            (other.scan_features(density), net.scan_features(density)),
            (other.map_features(picture), net.map_features(picture)),
        ]
    for found, expected in pairs:
        assert found.shape == expected.shape == (batch, 8, height // 2, width // 2)
        assert expected.abs().max() > 0.05
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", [name for name in FP32 if name != "openvino-bf16"])
def test_likelihoods_are_torch_s(name: str, folder: Path) -> None:
    installed(name)
    torch_matcher, other = shipped_for_scenes(), load_matcher(str(folder), name)
    assert isinstance(other, VotingMatcher)
    assert other.name == f"rotmatch-{name}"
    assert other.error_correlation_length_m == torch_matcher.error_correlation_length_m
    one = scene(7)
    ours, theirs = matched(torch_matcher, one), other.match_counts(one.counts, one.raster, near(one))
    assert theirs.grid == ours.grid
    assert np.ptp(ours.log_prob) > 1.0
    np.testing.assert_allclose(theirs.log_prob, ours.log_prob, atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", FP32)
def test_a_checkpoint_runs_in_a_backend_without_a_folder(name: str, tmp_path: Path) -> None:
    installed(name)
    torch.manual_seed(4)
    matcher = RotMatch(RotMatchNet(SMALL), Calibration(1.7, 9.0))
    matcher.save(tmp_path / "net.safetensors", {})
    other = load_matcher(str(tmp_path / "net.safetensors"), name)
    assert isinstance(other, VotingMatcher)
    assert other.calibration == matcher.calibration
    one = scene(3)
    volume = other.match_counts(one.counts, one.raster, near(one))
    expected = matched(matcher, one)
    np.testing.assert_allclose(volume.log_prob, expected.log_prob, atol=0.05 * np.ptp(expected.log_prob), rtol=0)


@pytest.mark.parametrize("name", INT8)
def test_8_bits_say_nearly_the_same(name: str, rounded: Path) -> None:
    """Rounding moves the scores by a fraction of their spread; a wrong scale or order would move them by all of it."""
    installed(name)
    assert (rounded / "scan.int8.onnx").stat().st_size < 0.5 * (rounded / "scan.onnx").stat().st_size
    other = load_matcher(str(rounded), name)
    assert isinstance(other, VotingMatcher)
    one = scene(11)
    ours, theirs = matched(shipped_for_scenes(), one), other.match_counts(one.counts, one.raster, near(one))
    assert np.corrcoef(ours.log_prob.ravel(), theirs.log_prob.ravel())[0, 1] > 0.95
    assert np.abs(ours.log_prob - theirs.log_prob).max() > 1e-3  # it was rounded


def test_an_export_removes_8_bit_graphs_of_before(tmp_path: Path) -> None:
    """They may be of other weights."""
    (tmp_path / "map.int8.onnx").write_bytes(b"of before")
    export(RotMatch(RotMatchNet(SMALL)), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"export.json", "scan.onnx", "map.onnx"}


def test_an_export_holds_no_pickle_and_says_what_it_is(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {"export.json", "scan.onnx", "map.onnx"}
    facts = json.loads((folder / "export.json").read_text())
    assert facts["architecture"] == "rotmatch-1"
    assert facts["settings"]["bev"]["half_extent_m"] == BEV.half_extent_m
    assert facts["graphs"] == {"fp32": {"scan": "scan.onnx", "map": "map.onnx"}}


SPOILS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no index": (lambda path: (path / "export.json").unlink(), "expected export.json in it"),
    "no graph": (lambda path: (path / "map.onnx").unlink(), "cannot be read"),
    "index is no JSON": (lambda path: (path / "export.json").write_text("{"), "expected a readable export.json"),
    "index is a list": (lambda path: (path / "export.json").write_text("[]"), "expected a JSON object"),
    "index is of another network": (lambda path: change(path, architecture="other-3"), "got 1 of other-3"),
    "index without calibration": (lambda path: change(path, calibration=None), "expected a readable export.json"),
    "graph is no graph": (
        lambda path: (path / "map.onnx").write_bytes(b"nonsense"),
        "expected a graph that it can run",
    ),
}


def change(path: Path, **facts: object) -> None:
    """Replace entries of an index."""
    index = path / "export.json"
    index.write_text(json.dumps({**json.loads(index.read_text()), **facts}))


@pytest.mark.parametrize("name", ["openvino", "onnxruntime"])
@pytest.mark.parametrize("spoil", SPOILS)
def test_spoilt_folders_are_one_line(name: str, spoil: str, folder: Path, tmp_path: Path) -> None:
    installed(name)
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    work, message = SPOILS[spoil]
    work(tmp_path)
    with pytest.raises(SkyfixError, match=message) as caught:
        load_exported(tmp_path, BACKENDS[name])
    assert "\n" not in str(caught.value)


def test_what_cannot_be_run_is_named(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SkyfixError, match=r"backend: expected torch or one of openvino, .*, got 'tea'"):
        load_matcher("rotmatch", "tea")
    with pytest.raises(SkyfixError, match="expected rotmatch or a checkpoint of it, got geometric"):
        load_matcher("geometric", "openvino")
    with pytest.raises(SkyfixError, match="expected a folder of `skyfix export --int8`, got rotmatch"):
        load_matcher("rotmatch", "openvino-int8")
    with pytest.raises(SkyfixError, match=r"expected openvino or onnxruntime for the export .*, got torch"):
        load_matcher(str(folder), "torch")
    with pytest.raises(SkyfixError, match="expected int8 graphs for openvino-int8, got fp32"):
        load_matcher(str(folder), "openvino-int8")
    with pytest.raises(SkyfixError, match="export: expected a RotMatch, got geometric"):
        export(GeometricMatcher(), tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SkyfixError, match="cannot be written"):
        export(shipped_for_scenes(), tmp_path / "file")
    monkeypatch.setattr("learned.backends.find_spec", lambda package: None)
    with pytest.raises(SkyfixError, match="expected the package openvino, got none: pip install"):
        load_matcher("rotmatch", "openvino")
    with pytest.raises(SkyfixError, match="got neither: pip install"):
        load_matcher(str(folder))


def test_the_first_installed_backend_computes_in_32_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("learned.backends.find_spec", lambda package: package == "onnxruntime" or None)
    assert first_installed().name == "onnxruntime"


def test_command_writes_a_folder_that_can_be_loaded(
    made_drive: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    RotMatch(RotMatchNet(SMALL), Calibration(1.7, 9.0)).save(tmp_path / "net.safetensors", {})
    out = tmp_path / "out"
    arguments = ["skyfix", "export", str(tmp_path / "net.safetensors"), "--out", str(out)]
    rounding = all(find_spec(package) for package in ("onnx", "onnxruntime"))
    monkeypatch.setattr(sys, "argv", [*arguments, *(["--int8", str(made_drive.path), "--frames", "2"] * rounding)])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 0
    assert capsys.readouterr().out == f"export: {out / 'export.json'}\n"
    assert (out / "map.int8.onnx").exists() == rounding
    assert json.loads((out / "export.json").read_text())["calibration"]["temperature"] == 1.7


def test_images_are_of_as_many_scans_as_asked_for(made_drive: MadeDrive) -> None:
    drive, matcher = FolderSequence(made_drive.path, 0), RotMatch(RotMatchNet(SMALL))
    images = matched_images(drive, matcher, 3)
    assert len(images) == 3
    for density, picture in images:
        assert density.shape == (4, BEV.size, BEV.size)
        assert picture.shape == (3, 144, 144)
    with pytest.raises(SkyfixError, match="frames: expected >= 1, got 0"):
        matched_images(drive, matcher, 0)


def test_training_goes_on_with_workers_where_openvino_has_run(folder: Path) -> None:
    pytest.importorskip("openvino", reason="openvino is not installed")
    matched(load_exported(folder, BACKENDS["openvino"]), scene(0))
    settings = TrainingSettings(steps=3, batch=2, workers=1)
    batches = list(training_batches(Landmarks(4), settings, first=0))
    assert len(batches) == 3
