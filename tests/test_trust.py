"""Whether a run is to be believed: doubts where there is reason, and none on a drive that went well."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive

from fusion.odometry_errors import OdometryCalibration
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.run_directory import write_run
from sequences.run_files import read_metrics
from sequences.run_result import FrameRow
from sequences.tables import closing_lines
from sequences.track_settings import TrackSettings
from sequences.trust import trust

UNIFORM = -math.log(4.0 * 20.0**2 * 0.4)
ROW = FrameRow(0, 0, True, "", UNIFORM + 4.0, 100.0, 0.001, 1.0, 20.0, 0.2, {})


def rows(gains: list[float], lost: list[float]) -> list[FrameRow]:
    return [replace(ROW, log_evidence=UNIFORM + gain, lost_score=now) for gain, now in zip(gains, lost, strict=True)]


def test_evidence_is_counted_from_that_of_a_random_pose() -> None:
    unmeasured = replace(
        ROW, measured=False, log_evidence=None, search_half_extent_m=None, search_half_heading_rad=None
    )
    found = trust([*rows([1.0, 3.5, 9.0], [0.0] * 3), unmeasured], OdometryCalibration())
    assert found.evidence_gain_nats == pytest.approx(3.5)
    assert found.lost_share == 0.0
    assert found.doubts == []
    full = replace(ROW, search_half_heading_rad=4.0, log_evidence=-math.log(1600.0 * 2.0 * math.pi) + 5.0)
    short = trust([full], OdometryCalibration())
    assert short.evidence_gain_nats == pytest.approx(5.0)
    assert short.doubts == []  # one scan of one


def test_what_is_flattened_more_has_to_say_less() -> None:
    flattened = [replace(row, temperature=6.2) for row in rows([1.6] * 3, [0.0] * 3)]
    assert trust(flattened, OdometryCalibration()).doubts == []
    assert len(trust(rows([1.6] * 3, [0.0] * 3), OdometryCalibration()).doubts) == 1
    assert trust(rows([-0.8] * 2, [0.0] * 2), OdometryCalibration()).doubts == []  # too few to judge by


def test_a_map_without_buildings_is_a_doubt() -> None:
    (found,) = trust(rows([4.0] * 3, [0.0] * 3), OdometryCalibration(), shows_buildings=False).doubts
    assert found.startswith("the map shows no buildings")


def test_an_odometry_that_jumps_all_the_time_is_a_doubt() -> None:
    frames = rows([4.0] * 100, [0.0] * 100)
    assert trust(frames, OdometryCalibration(), jumps=5).doubts == []
    (found,) = trust(frames, OdometryCalibration(), jumps=6).doubts
    assert found == "the odometry jumps 6 times: is it in metres, its times in seconds?"
    assert trust(frames[:10], OdometryCalibration(), jumps=3).doubts == []


@pytest.mark.parametrize(
    ("gains", "lost", "calibration", "doubt"),
    [
        ([1.0, 2.9, 9.0], [0.0, 0.0, 0.0], OdometryCalibration(), r"hardly agree with the map .* 2\.9 nats"),
        ([4.0], [0.0], OdometryCalibration(), "only 1 of 12 scans were matched"),
        ([4.0, 4.0, 4.0], [0.6, 0.0, 0.0], OdometryCalibration(), "lost for 1 of 3 frames: "),
        ([4.0, 4.0, 4.0], [0.0, 0.6, 0.9], OdometryCalibration(), "lost for 2 of 3 frames, at the end too: "),
        ([4.0, 4.0, 4.0], [0.0] * 3, OdometryCalibration(log_scale=-0.2), r"distances -18\.1 %"),
        ([4.0, 4.0, 4.0], [0.0] * 3, OdometryCalibration(heading_noise=6.0), r"6\.0 times the usual noise"),
    ],
)
def test_each_reason_is_a_doubt(
    gains: list[float], lost: list[float], calibration: OdometryCalibration, doubt: str
) -> None:
    unmeasured = replace(ROW, measured=False, log_evidence=None)
    standing = [unmeasured] * 11 if len(gains) == 1 else []
    (found,) = trust([*rows(gains, lost), *standing], calibration).doubts
    assert re.search(doubt, found)


def test_a_run_says_in_every_place_whether_to_believe_it(made_drive: MadeDrive, tmp_path: Path) -> None:
    """Scans that show other places than those driven through are doubted, with no ground truth asked."""
    (made_drive.path / "ground_truth.tum").unlink()
    drive, truth = FolderSequence(made_drive.path), made_drive.truth.poses
    settings = TrackSettings("wheels", start=tuple(truth[0]), snapshots=2)
    good = track(drive, EmulatedMatcher(truth), settings)
    assert good.metrics["trust"]["doubts"] == []
    rng = np.random.default_rng(2)
    mistakes = {k: np.append(rng.uniform(-15.0, 15.0, 2), 0.0) for k in range(len(truth))}
    bad = track(drive, EmulatedMatcher(truth, mistakes=mistakes), settings)
    doubt = bad.metrics["trust"]["doubts"][0]
    assert doubt.startswith("the scans hardly agree with the map")
    report = write_run(bad, tmp_path / "run")
    assert read_metrics(tmp_path / "run")["trust"] == bad.metrics["trust"]
    assert f"doubtful: {doubt}" in closing_lines(bad.metrics)
    assert "Doubtful: the scans hardly agree" in report.read_text(encoding="utf-8")


def test_the_map_of_a_run_is_judged(made_drive: MadeDrive) -> None:
    layers = json.loads((made_drive.path / "map.json").read_text())
    layers["layers"][0]["classes"] = ["grass", "road"]
    (made_drive.path / "map.json").write_text(json.dumps(layers))
    bare = track(FolderSequence(made_drive.path), EmulatedMatcher(made_drive.truth.poses), TrackSettings("wheels"))
    assert [doubt[:26] for doubt in bare.metrics["trust"]["doubts"]] == ["the map shows no buildings"]
