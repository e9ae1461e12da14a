"""A network of one's own on the command line: a file and a name in it are enough, and what is wrong is said."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import skyfix
from made_drive import MadeDrive

from fusion import GaussianLikelihood, MapGrid
from fusion.errors import SkyfixError
from learned.answers import match_scan
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion, load_matcher
from learned.own_matcher import OwnMatcher, own_matcher_named
from sequences.evaluation_tables import matcher_labels
from sequences.sweep_plan import matcher_label

NETWORK = """
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from beside import sigma_m
from made_drive import EmulatedMatcher

from fusion import GaussianLikelihood, LikelihoodVolume, LocationOrientationMaps, MapGrid
from sequences.trajectory_io import read_tum


@dataclass
class Mine(EmulatedMatcher):
    truth: object = None
    name: str = "mine"

    def __post_init__(self):
        self.truth = read_tum(Path(TRUTH), "map").poses
        self.sigma_m = sigma_m


def made_by_a_function():
    return Mine(name="from a function")


made_before = Mine(name="made before")


class Silent(Mine):
    def match(self, *arguments):
        return None


class Needy:
    def __init__(self, weights):
        pass


class Nothing:
    name = "nothing"
    error_correlation_length_m = 1.0


class Endless(Nothing):
    error_correlation_length_m = float("inf")
    match = None


class Failing(Nothing):
    def match(self, *arguments):
        return {}["weights"]


class Elsewhere(Nothing):
    def match(self, *arguments):
        return LikelihoodVolume.from_scores(np.zeros((20, 20, 8)), MapGrid(20, 20, 1.0, 990.0, 990.0))


class Unnormalised(Nothing):
    def match(self, points, ground_z, map_raster, search):
        return LikelihoodVolume.from_scores(np.full((20, 20, 8), np.nan), MapGrid(20, 20, 1.0, 0.0, 0.0))


class Pose(Nothing):
    def match(self, points, ground_z, map_raster, search):
        grid = map_raster.grid.window(search.centre[:2], search.half_extent_m)
        return GaussianLikelihood([4.0, 3.0, 0.5], np.diag([1.0, 2.0, 0.04]), grid)


class Maps(Pose):
    def match(self, *arguments):
        volume = super().match(*arguments).to_volume(90)
        step = 2 * np.pi / 90
        location = np.logaddexp.reduce(volume.log_prob, axis=2) + np.log(step)
        orientation = np.moveaxis(volume.log_prob - location[:, :, None], 2, 0)
        return LocationOrientationMaps(location, orientation, volume.grid)


class Nameless(Nothing):
    name = ""
    match = None
"""


CITY = MapGrid(100, 100, 0.5, -20.0, -20.0)
BARE = MapRaster.from_classes(CITY, np.zeros((100, 100), dtype=np.uint8))


@pytest.fixture
def file(made_drive: MadeDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's file, which imports another beside it and knows the made drive's truth."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "beside.py").write_text("sigma_m = 0.5\n")
    path = folder / "network.py"
    path.write_text(NETWORK.replace("TRUTH", repr(str(made_drive.path / "ground_truth.tum"))))
    yield path
    sys.modules.pop("beside", None)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mine.py:Network", OwnMatcher("mine.py", "Network")),
        ("/some where/mine.py:Network", OwnMatcher("/some where/mine.py", "Network")),
        ("package.networks:make", OwnMatcher("package.networks", "make")),
        ("rotmatch", None),
        ("C:\\runs\\net.safetensors", None),
        ("runs/net.safetensors", None),
        ("mine.py", None),
        ("mine.py:", None),
        (":Network", None),
        ("runs/net:Network", None),
    ],
)
def test_what_names_a_matcher_of_ones_own(text: str, expected: OwnMatcher | None) -> None:
    assert own_matcher_named(text) == expected


@pytest.mark.parametrize(
    ("name", "called"), [("Mine", "mine"), ("made_by_a_function", "from a function"), ("made_before", "made before")]
)
def test_a_class_a_function_and_a_matcher_will_do(file: Path, name: str, called: str) -> None:
    assert load_matcher(f"{file}:{name}").name == called


def test_an_importable_module_will_do(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(file.parent)
    assert load_matcher("network:Mine").name == "mine"
    sys.modules.pop("network")


def test_a_drive_is_tracked_and_swept_with_it(
    file: Path,
    made_drive: MadeDrive,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive, out = str(made_drive.path), tmp_path / "run"
    done = skyfix(capsys, monkeypatch, "track", drive, "--matcher", f"{file}:Mine", "--out", str(out))
    assert done.code == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["filter"]["position_error_m"]["mean"] < 0.6 * metrics["odometry"]["position_error_m"]["mean"]
    sweep = ["sweep", drive, "--odometry", "wheels", "--matcher", f"{file}:Mine", "--out", str(tmp_path / "sweep")]
    assert skyfix(capsys, monkeypatch, *sweep).code == 0
    assert "network:Mine" in (tmp_path / "sweep" / "sweep.md").read_text()
    again = skyfix(capsys, monkeypatch, *sweep)
    assert (again.code, "1 of 1 runs are there already" in again.out + again.err) == (0, True)
    later = file.stat().st_mtime + 1000.0
    os.utime(file, (later, later))
    changed = skyfix(capsys, monkeypatch, *sweep)
    assert changed.code == 2
    assert "is older than" in changed.err


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("network.py:Other", "matcher network:Other: expected Other there, got"),
        ("other.py:Mine", "matcher other:Mine: expected the Python file "),
        ("no_such_package.networks:Mine", "cannot be imported: ModuleNotFoundError: No module named 'no_such_package'"),
        ("network.py:Needy", "cannot be made without arguments: TypeError: .*missing 1 required positional argument"),
        ("network.py:Nothing", "got a Nothing without match"),
        ("network.py:Endless", "error_correlation_length_m: expected metres >= 0, got inf"),
        ("network.py:Nameless", "name: expected a text, got ''"),
        ("broken.py:Mine", r"cannot be imported: SyntaxError: .*\(broken.py, line 2\)$"),
        ("raising.py:Mine", r"cannot be imported: RuntimeError: no weights here \(raising.py, line 4\)$"),
        ("leaving.py:Mine", r"cannot be imported: SystemExit: 3 \(leaving.py, line 1\)$"),
    ],
)
def test_what_is_wrong_is_one_line(file: Path, name: str, message: str) -> None:
    (file.parent / "broken.py").write_text("\ndef f(:\n")
    (file.parent / "raising.py").write_text("import sys\n\n\nraise RuntimeError('no weights\\nhere')\n")
    (file.parent / "leaving.py").write_text("raise SystemExit(3)\n")
    text = name if name.startswith("no_such") else f"{file.parent}/{name}"
    with pytest.raises(SkyfixError, match=message) as caught:
        load_matcher(text)
    assert "\n" not in str(caught.value)


def test_a_runtime_is_for_skyfix_own_networks(file: Path) -> None:
    pytest.importorskip("onnxruntime")
    with pytest.raises(SkyfixError, match="backend onnxruntime: expected rotmatch or a checkpoint of it, got mine"):
        load_matcher(f"{file}:Mine", "onnxruntime")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Failing", r"matcher nothing: match\(\) failed: KeyError: 'weights' \(network.py, line \d+\)$"),
        ("Elsewhere", "matcher nothing: expected an answer about x 3 y 4, got one about x 1000 y 1000$"),
        ("Unnormalised", "scores: expected finite values at the valid cells, got NaN or an infinity"),
    ],
)
def test_an_answer_of_no_use_is_one_line(file: Path, name: str, message: str) -> None:
    search = SearchRegion(np.array([3.0, 4.0, 0.0]), 10.0)
    with pytest.raises(SkyfixError, match=message):
        match_scan(load_matcher(f"{file}:{name}"), np.zeros((1, 4), np.float32), -1.7, BARE, search)


@pytest.mark.parametrize("name", ["Pose", "Maps"])
def test_a_pose_with_a_covariance_and_maps_will_do_as_answers(file: Path, name: str) -> None:
    search = SearchRegion(np.array([3.0, 4.0, 0.0]), 10.0)
    volume = match_scan(load_matcher(f"{file}:{name}"), np.zeros((1, 4), np.float32), -1.7, BARE, search)
    mean, covariance = np.array([4.0, 3.0, 0.5]), np.diag([1.0, 2.0, 0.04])
    near = np.random.default_rng(0).multivariate_normal(mean, covariance, 200)
    expected = GaussianLikelihood(mean, covariance, volume.grid).log_density(near)
    np.testing.assert_allclose(volume.log_density(near), expected, atol=0.06)  # interpolated between cells


@pytest.mark.parametrize(("command", "code"), [("track", 2), ("evaluate", 2), ("check", 1)])
def test_an_answer_that_is_no_likelihood_is_one_line(
    command: str,
    code: int,
    file: Path,
    made_drive: MadeDrive,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    done = skyfix(capsys, monkeypatch, command, str(made_drive.path), "--matcher", f"{file}:Silent")
    assert done.code == code
    assert "expected match() to answer with a LikelihoodVolume, got NoneType" in " ".join((done.out + done.err).split())
    assert not (tmp_path / "runs").exists()


def test_tables_call_it_by_its_own_name() -> None:
    assert matcher_label("a/mine.py:Network") == "mine:Network"
    assert list(matcher_labels(["rotmatch", "a/mine.py:Network"])) == ["rotmatch", "mine:Network"]
    assert list(matcher_labels(["a/mine.py:Network", "b/mine.py:Network"])) == [
        "a/mine.py:Network",
        "b/mine.py:Network",
    ]
