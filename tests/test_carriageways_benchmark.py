"""The table of tracked drives by how far errors are taken to repeat: what `track` finds, drive by drive."""

import numpy as np
import pytest
from made_drive import EmulatedMatcher, write_made_drive

from benchmarks import carriageways
from benchmarks.drawn_drives import CARRIAGEWAYS
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.track_settings import TrackSettings


def test_a_row_for_every_method_and_length_with_the_prior_and_the_odometry_first(
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    made = write_made_drive(tmp_path_factory.mktemp("benchmark") / "made_drive")
    (made.path / "odometry" / "wheels.tum").rename(made.path / "odometry" / "emulated.tum")
    drive, matcher = FolderSequence(made.path), EmulatedMatcher(made.truth.poses)
    asked: list[tuple[int, str]] = []
    monkeypatch.setattr(carriageways, "DrawnDrive", lambda number, kind: asked.append((number, kind)) or drive)
    monkeypatch.setattr(carriageways, "load_matcher", lambda name: matcher)
    carriageways.main(worlds=2, length_m=[0.0, 30.0])
    assert asked == [(0, CARRIAGEWAYS), (1, CARRIAGEWAYS)]
    lines = capsys.readouterr().out.splitlines()
    assert "2 worlds, emulated, scans simulated, maps of carriageways alone" in lines
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")][2:]
    lengths = [(row[0], row[1]) for row in rows]
    assert lengths[:2] == [("prior", "-"), ("odometry only (emulated)", "-")]
    methods = ("single shot", "filter", "filter after a quarter", "smoother")
    assert lengths[2:] == [(method, length) for method in methods for length in ("0", "30")]
    settings = [TrackSettings("emulated", seed=seed, correlation_length_m=30.0, snapshots=0) for seed in (0, 1)]
    found = [track(drive, matcher, each).metrics["smoother"] for each in settings]
    columns = [
        [each["position_error_m"]["mean"] for each in found],
        [each["heading_error_deg"]["mean"] for each in found],
        [100.0 * each["ellipse95"] for each in found],
        [each["nees"]["mean"] for each in found],
    ]
    for shown, values, digits in zip(rows[-1][2:], columns, (2, 2, 0, 2), strict=True):
        assert shown == f"{np.mean(values):.{digits}f} ± {np.std(values, ddof=1):.{digits}f}"
